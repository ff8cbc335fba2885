"""Closed forms of docs/theory.md."""


def ladder_rule(pattern: str, depth: int) -> bool:
    """docs/theory.md, Sec. 4: always right, or a first zero at j < n - 1 - m and another one at j + m + 1 or above."""
    if "0" not in pattern:
        return set(pattern) == {"1"}
    j = pattern.index("0")
    return j + depth < len(pattern) - 1 and "0" in pattern[j + depth + 1 :]
