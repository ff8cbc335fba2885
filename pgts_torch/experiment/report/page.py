"""The HTML page about a run."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from pgts_torch import files
from pgts_torch.agent.pgts import PGTS
from pgts_torch.experiment.ownership import REPORT_FILE
from pgts_torch.experiment.pictures import policy_picture
from pgts_torch.experiment.report.curves import draw
from pgts_torch.experiment.report.facts import gather
from pgts_torch.experiment.report.html import Filters, image, render, typeset
from pgts_torch.experiment.resume import resuming
from pgts_torch.tabular import exact

SIGN = b'<meta name="generator" content="pgts report">'
"""A tag by which a page of `pgts report` is recognised."""


def write(run: Path, out: Path | None, *, trust_imports: bool = False) -> dict[str, Any]:
    """Write the page about a run, by default into its folder.

    Returns:
        The content of the page as plain values, without the picture of the policy; "page" is its path.

    Raises:
        PgtsError: the configuration of the run cannot be read, or the page cannot be written, for instance because
            another file is in its place.
    """
    torch.set_num_threads(1)
    out = files.target(run / REPORT_FILE if out is None else out, lambda raw: SIGN in raw, "a page of pgts report")
    facts, algorithm = gather(run, trust_imports=trust_imports)
    policy = None if algorithm is None or algorithm.world.mdp is None else _policy(algorithm)
    resume = resuming(facts["run"], facts["world_size"], imports=facts["imports"])
    filters: Filters = {"tiles": tiles, "curve": lambda panel: image(draw(panel), transparent=True)}
    files.replace(out, render("page.html", {**facts, "policy": policy, "resume": resume}, filters=filters))
    return {"page": str(out), **facts}


def _policy(algorithm: PGTS) -> dict[str, Any]:
    """The template values about a tabular policy, with a picture of v^pi and pi."""
    mdp, pi_SA = algorithm.mdp, algorithm.policy_table().cpu()
    return {
        "step": algorithm.num_env_steps,
        "J": exact.evaluate(mdp, pi_SA).J,
        "J_optimal": exact.optimal(mdp).J,
        "num_states": mdp.num_states,
        "actions": ", ".join(mdp.action_names),
        "picture": image(policy_picture(mdp, pi_SA)),
    }


def tiles(rows: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Return (name, number, text) for each row, where the text begins with a number; those with numbers first."""
    found = []
    for name, text in rows.items():
        number, _, rest = text.partition(" ")
        if name != "run folder" and re.fullmatch(r"[-+]?[0-9.]+(e[-+]?[0-9]+)?", number):
            shown = f"{int(number):,}" if number.isdecimal() else typeset(number)
            found.append((typeset(name), shown, typeset(rest.strip("()"))))
        else:
            found.append((name, "", text))
    return sorted(found, key=lambda tile: not tile[1])
