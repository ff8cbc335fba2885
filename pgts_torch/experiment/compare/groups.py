"""Groups of runs that are one up to the seed, each with a letter and a label that tells it from the others."""

import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pgts_torch.errors import PgtsError
from pgts_torch.experiment.compare.runs import Notes, Trained

FEW_KEYS = 4


@dataclass(frozen=True)
class Group:
    """Runs that are one, up to the seed.

    settings: the keys in which groups differ, with the value of this one; None: its configuration has no such key.
    """

    letter: str
    label: str
    settings: Mapping[str, Any]
    runs: Sequence[Trained]


def grouped(runs: Sequence[Trained], by: str, notes: Notes) -> list[Group]:
    """Groups in the order of their labels, in which numbers are in the order of numbers."""
    labels: Mapping[str, str]
    if by == "config":
        found = by_key((json.dumps(run.settings), run) for run in runs)
        labels = dict(zip(found, _labels([members[0] for members in found.values()]), strict=True))
    elif by in ("name", "folder"):
        found = by_key((run.config.name if by == "name" else str(run.path.parent), run) for run in runs)
        labels = {key: key for key in found}
    else:
        found = by_key(_matched(runs, by, notes))
        labels = {key: key for key in found}
    if not found:
        raise PgtsError(f"--by {by!r} matches the path of no run, such as {runs[0].path}")
    differing = _differing([run.settings for run in runs])
    groups = []
    for number, key in enumerate(sorted(found, key=lambda key: _natural(labels[key]))):
        members = found[key]
        own = _differing([run.settings for run in members])
        if own:
            shown = ", ".join(own[:4]) + (f" and {len(own) - 4} more" if len(own) > 4 else "")
            notes.add(f"runs of {labels[key]} differ in {shown}, and are one group all the same")
        settings = {key: members[0].settings.get(key) for key in differing if key not in own}
        groups.append(Group(_letter(number), labels[key], settings, members))
    return groups


def _matched(runs: Sequence[Trained], pattern: str, notes: Notes) -> Iterator[tuple[str, Trained]]:
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise PgtsError(
            f"--by {pattern!r} is neither config, name nor folder, nor a regular expression: {error}"
        ) from None
    for run in runs:
        match = compiled.search(str(run.path))
        if match is None:
            notes.add("left out, as --by does not match their paths", str(run.path))
        else:
            yield next((group for group in match.groups() if group is not None), match[0]), run


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The keys in which they differ, in the order of the configuration."""
    keys = dict.fromkeys(itertools.chain.from_iterable(settings))
    return [key for key in keys if len({json.dumps(each.get(key, "no such key")) for each in settings}) > 1]


def _labels(runs: Sequence[Trained]) -> list[str]:
    """A name for each of several configurations: the keys in which they differ where these are few, else the first by
    which they can be told apart."""
    settings = [run.settings for run in runs]
    differing = sorted(_differing(settings), key=lambda key: key.rpartition(".")[2] not in ("type", "kind"))
    keys: list[str] = []
    told = 1
    for key in differing:
        apart = len({json.dumps([each.get(name, "no such key") for name in (*keys, key)]) for each in settings})
        if apart > told:
            keys, told = [*keys, key], apart
    if not keys:
        return [run.config.name for run in runs]
    if len(differing) <= FEW_KEYS:
        keys = differing
    for digits in (4, 6, 17):  # the fewer where they suffice
        labels = [
            ", ".join(f"{key} {_shown(each[key], digits)}" for key in keys if key in each) or "others"
            for each in settings
        ]
        if len(set(labels)) == told:
            break
    return labels


def _shown(value: Any, digits: int) -> str:
    if isinstance(value, float):
        return f"{value:.{digits}g}"
    return value if isinstance(value, str) else json.dumps(value)


def _natural(label: str) -> list[tuple[int, float, str]]:
    """A key by which numbers in a text sort as numbers."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)", label)
    return [(1, float(part), "") if odd % 2 else (0, 0.0, part) for odd, part in enumerate(parts)]


def _letter(number: int) -> str:
    """A, B, ..., Z, AA, AB, ... as in a spreadsheet."""
    before, last = divmod(number, 26)
    return (_letter(before - 1) if before else "") + chr(ord("A") + last)


def by_key(pairs: Iterable[tuple[str, Trained]]) -> dict[str, list[Trained]]:
    found: dict[str, list[Trained]] = {}
    for key, run in pairs:
        found.setdefault(key, []).append(run)
    return found
