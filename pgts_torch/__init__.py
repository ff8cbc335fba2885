"""Policy gradient with tree search."""
