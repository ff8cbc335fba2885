"""The command `pgts`. It imports torch only after the arguments have been checked: errors and help appear at once."""
