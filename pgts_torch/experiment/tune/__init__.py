"""Optuna proposes values of options; what they are worth is found out by trainings, in ordinary run folders."""
