"""The configuration to begin with in an environment, with the model that was found and the price that was measured."""

import math
import re
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from gymnasium import spaces

from pgts_torch import files
from pgts_torch.agent.components import inputs
from pgts_torch.agent.observations import fit_keys
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.worlds import DynamicsWorld, SimulatedWorld, TabularWorld
from pgts_torch.config import Config
from pgts_torch.errors import MissingModel, PgtsError
from pgts_torch.experiment.commented import commented
from pgts_torch.experiment.resume import plain
from pgts_torch.experiment.run import build
from pgts_torch.models.base import LearningModel
from pgts_torch.models.environments import EnvSource
from pgts_torch.options.rollouts import FixedHorizon, Rollouts

PATIENCE = 600.0
"""The seconds that the whole training is to take, as far as its second iteration tells; or twice as long as with the
smallest depth, if that is more."""

LONG = 10.0
"""Where an iteration takes more seconds with the smallest depth, its lookahead starts from fewer states."""

LONGEST_EPISODE = 500
"""The most steps of a rollout, where the environment's own time limit is longer; `FixedHorizon` where it has none."""

SLOW = 120.0
"""Where an iteration of the usual size would take more seconds, even with few states to look ahead from, a smaller one
is proposed, as it was tried."""

FIRST = {"num_envs": 4, "length": 100, "max_roots": 50}
"""The smaller iteration in which depths are tried, so that nothing is waited for that is not proposed."""

FEWEST_ROOTS = 16
"""It starts from so many at least."""

TABLE_DEPTHS, OTHER_DEPTHS = (1, 2, 4, 8, 16), (0, 1, 2, 4)
"""The depths that are tried, in this order. A table is read without queries, and paths meet in its states."""

LEARNED_DEPTH = 1
"""Deeper lookaheads add up the errors of a model of vectors that is learned."""


@dataclass(frozen=True)
class Proposal:
    """A configuration to begin with.

    model: what its lookahead queries, in words.
    why: what the environment lacks for a model that need not be learned; empty where it lacks nothing.
    shows: observations and actions, in words.
    price: what an iteration costs, in a sentence.
    seconds: of the whole training, as far as its second iteration tells.
    """

    config: Config
    model: str
    why: str
    shows: str
    price: str
    seconds: float


def target(env_id: str, out: Path | None, *, overwrite: bool) -> Path:
    """The file to write, by default NAME.yaml in the working folder; PgtsError if it exists and is not to be replaced,
    or is no file."""
    path = Path(f"{_name(env_id)}.yaml") if out is None else out
    found = files.kind(path, follow=True) or files.kind(path)
    if found not in (None, "file"):
        raise PgtsError(f"{path} is a {found}; -o must name a file")
    if found is not None and not overwrite:
        raise PgtsError(f"{path} exists: give --overwrite to replace it, or another name by -o")
    if files.kind(path.parent, follow=True) != "folder":
        raise PgtsError(f"{path} cannot be written: {path.parent} is not a folder")
    return path


def propose(env_id: str, *, kwargs: Mapping[str, Any], seed: int) -> Proposal:
    """Find a model for an environment as training does, try trainings of two iterations, and choose.

    The first of these that applies: a model that is known (table, dynamics, simulator); one that is learned from the
    steps; none, with the advantages of the actions taken. The depth is the largest of a few with which the training
    takes less than ten minutes, or less than twice as long as with the smallest.

    Raises:
        PgtsError: the environment cannot be made, or no agent can act in it, or it fails.
    """
    torch.set_num_threads(1)
    source = EnvSource.of(env_id, kwargs=kwargs)
    with closing(source.make_one()) as env:
        is_continuous, space = isinstance(env.action_space, spaces.Box), env.observation_space
    made: dict[str, Any] = {"id": source.description, "kwargs": dict(kwargs)}
    if isinstance(space, spaces.Dict) and 0 < len(keys := fit_keys(space)) < len(space):
        made["observation_keys"] = keys
    general = {"name": _name(env_id), "seed": seed, "env": made}
    limit = min(source.time_limit or LONGEST_EPISODE, LONGEST_EPISODE)
    fixed = {"rollout": {"horizon": {"type": "fixed", "length": limit}}} if source.time_limit else {}
    continuous = {"policy": {"type": "gaussian"}, "replay": {"type": "uniform"}} if is_continuous else {}
    own = continuous or fixed
    learned = {"policy": continuous["policy"]} if is_continuous else {}
    sampled = {
        "estimator": {"type": "sampled"},
        "search": {"depth": 0},
        "rollout": {"num_envs": 8, "horizon": {"type": "steps", "length": 128}},
    }
    kinds = ("ensemble",) if is_continuous else ("counts", "latent", "ensemble")
    ways = [own, *(learned | {"model": {"type": kind}} for kind in kinds), learned | sampled]
    why = ""
    for way in ways:
        try:
            if way is fixed:
                return _known_model(general, way, source.time_limit, limit)
            tried = _Tried.of(general | way, 0 if is_continuous or way is ways[-1] else LEARNED_DEPTH)
        except MissingModel as error:
            why = why or str(error)
            continue
        return replace(tried.proposal, why=why)
    raise AssertionError("sampled advantages need no model")


@dataclass(frozen=True)
class _Tried:
    """A training of two iterations: what it was made from and what it came to.

    steps: if not None, the numbers below are foreseen, for an iteration of at most so many steps (fewer where episodes
        end sooner) that looks ahead from all states that it visits.
    tables: whether the lookahead reads a table.   branching: actions.   roots: states that the lookahead starts from.
    iteration: the seconds of the second one.   looking: those of its lookahead.
    """

    data: dict[str, Any]
    proposal: Proposal
    steps: int | None
    tables: bool
    branching: int
    roots: int
    iteration: float
    looking: float

    @property
    def seconds(self) -> float:
        return self.proposal.seconds

    @property
    def depth(self) -> int:
        depth = self.proposal.config.search.depth
        assert isinstance(depth, int)
        return depth

    def again(self, **search: Any) -> "_Tried":
        """Try it with other options of the lookahead."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they were shown the first time
            return _Tried.of(self.data | {"search": self.data.get("search", {}) | search}, self.depth, self.steps)

    @classmethod
    def of(cls, data: dict[str, Any], depth: int, steps: int | None = None) -> "_Tried":
        """Try a training; `depth` where `data` names none."""
        data = data | {"search": {"depth": depth} | data.get("search", {})}
        with closing(build(Config.model_validate(data))) as algorithm:
            algorithm.iterate()
            begun = time.perf_counter()
            iteration = algorithm.iterate()
            seconds = time.perf_counter() - begun
            config = _whole(data, algorithm)
            price = algorithm.pricing.price
            said = f"an iteration takes about {seconds:.2g} s" if not price else str(replace(price, advice=()))
            if price is not None and not price.calls:
                said = f"an iteration takes about {seconds:.2g} s and no model calls, because the table is known"
            roots = 0 if iteration.state_N is None else len(iteration.state_N)
            looking, made = algorithm.pricing.looking, max(iteration.num_steps, 1)
            if steps is not None:
                steps = _usual_steps(iteration.experience, made, steps)
                rest = (seconds - looking) * steps / made
                all_roots = max(roots, _grown(iteration.experience, made, steps))
                looking, roots, made = looking * all_roots / max(roots, 1), all_roots, steps
                seconds = rest + looking
            proposal = Proposal(
                config=config,
                model=_model(algorithm),
                why="",
                shows=f"observations are {_shown(algorithm)}, {_actions(algorithm)}",
                price=said,
                seconds=seconds * config.total_steps / made,
            )
            tables = isinstance(algorithm.world, TabularWorld) and algorithm.world.mdp is not None
            branching = max(algorithm.world.num_actions, 2)
            return cls(data, proposal, steps, tables, branching, roots, seconds, looking)


def _known_model(general: dict[str, Any], fixed: dict[str, Any], time_limit: int | None, limit: int) -> Proposal:
    """The proposal with a model that need not be learned. Depths are tried in small iterations; what is proposed is
    tried at last, with as many states to look ahead from as take a few seconds.

    Raises:
        MissingModel: there is no such model.
    """
    length, num_envs = min(FIRST["length"], limit), FIRST["num_envs"]
    small = {"rollout": {"num_envs": num_envs, "horizon": {"type": "fixed", "length": length}}}
    search = {"search": {"max_roots": FIRST["max_roots"]}}
    steps = Rollouts.standing("fixed")["num_envs"] * (limit if time_limit else FixedHorizon().length)
    first = _Tried.of(general | small | search, 0, steps)
    if first.iteration - first.looking + first.looking * FEWEST_ROOTS / max(first.roots, FEWEST_ROOTS) > SLOW:
        return _Tried.of(general | small | search, 0).proposal
    if first.tables:
        return _deepest(_Tried.of(general | fixed, LEARNED_DEPTH)).proposal
    best = _deepest(first)
    options: dict[str, Any] = {"depth": best.depth}
    if best.iteration > LONG and best.roots > FEWEST_ROOTS:
        fewer = max(FEWEST_ROOTS, int(best.roots * LONG / best.looking))
        if fewer < best.roots:
            options["max_roots"] = int(float(f"{fewer:.1g}"))
    return _Tried.of(general | fixed | {"search": options}, best.depth).proposal


def _usual_steps(experience: Rollout, made: int, most: int) -> int:
    """How many steps an iteration of the usual number of episodes makes, at most `most`; those that were cut off in the
    `made` steps of a small one go on to the end."""
    count, length = FIRST["num_envs"], FIRST["length"]
    usual, alive_TB = Rollouts.standing("fixed")["num_envs"], experience.alive_TB
    cut_off = float(alive_TB[-1].double().mean()) if len(alive_TB) >= min(length, most // usual) else 0.0
    return min(most, round(usual * (made / count + cut_off * max(most / usual - length, 0))))


def _grown(experience: Rollout, made: int, steps: int) -> int:
    """How many distinct states `steps` steps visit, if their number is a power of that of the steps."""
    distinct = len(experience.state_UB[:-1].unique()) if experience.state_UB is not None else made
    return round(steps ** (math.log(max(distinct, 2)) / math.log(max(made, 2)))) if distinct < made else steps


def _deepest(first: _Tried) -> _Tried:
    """Try other depths, the smallest first, as long as the next one will probably not take too long."""
    best, limit = None, 0.0
    for depth in TABLE_DEPTHS if first.tables else OTHER_DEPTHS:
        if best is not None:
            # Until paths meet, each level takes as many times longer as there are actions.
            growth = 1.0 if first.tables else float(first.branching ** (depth - best.depth))
            if best.seconds * growth > limit:
                break
        tried = first if depth == first.depth else first.again(depth=depth)
        if best is None:
            limit = max(PATIENCE, 2 * tried.seconds)
        elif tried.seconds > limit:
            break
        best = tried
    assert best is not None
    return best


def _whole(data: Mapping[str, Any], algorithm: PGTS) -> Config:
    """The configuration of a training, with the parts that its environment chose."""
    options = algorithm.options.model_dump(by_alias=True)
    total = Config().total_steps
    chosen = {"env": data["env"], "total_steps": total, "eval": {"every": total // 10}}
    return Config.model_validate(dict(data) | options | chosen)


def _model(algorithm: PGTS) -> str:
    world = algorithm.world
    model = type(algorithm.world.model).__name__
    if algorithm.depth_choice is None:
        return "no model: the update takes the advantages of the actions taken"
    if isinstance(world.model, LearningModel):
        return f"a model that is learned from the steps ({algorithm.options.model.type})"
    if isinstance(world, TabularWorld):
        return f"the environment's table of {world.mdp_shape[0]:,} states"
    if isinstance(world, DynamicsWorld):
        return f"its dynamics in torch ({model})"
    if isinstance(world, SimulatedWorld):
        return "a simulator: the environment itself, restored from snapshots"
    return model


def _shown(algorithm: PGTS) -> str:
    space = algorithm.world.observation_space
    if isinstance(algorithm.world, TabularWorld):
        return "numbered states"
    if isinstance(space, spaces.Tuple):
        seen = inputs(space)  # without the legal actions
        space = seen[0] if len(seen) == 1 else spaces.Tuple(seen)
    if isinstance(space, spaces.Box):
        kind = {1: "vectors", 3: "images"}.get(len(space.shape), "arrays")
        return f"{kind} of {' x '.join(map(str, space.shape))}"
    if isinstance(space, spaces.Dict):
        return f"dictionaries of {', '.join(space)}"
    return f"tuples of {len(space)}" if isinstance(space, spaces.Tuple) else str(space)


def _actions(algorithm: PGTS) -> str:
    world = algorithm.world
    if not world.num_actions:
        return f"actions are vectors of {world.action_size}"
    masked = ", some of which are not legal everywhere" if world.masks not in (None, "off") else ""
    return f"there are {world.num_actions} actions{masked}"


def _name(env_id: str) -> str:
    """A word for a run and a file, as minigrid_empty_5x5 for MiniGrid-Empty-5x5-v0."""
    last = re.sub(r"-v\d+$", "", re.split(r"[:/]", env_id)[-1])
    return re.sub(r"[^a-z0-9]+", "_", last.lower()).strip("_") or "run"


def describe(proposal: Proposal) -> Iterator[str]:
    """Yield what was found, in sentences."""
    config, training = proposal.config, proposal.seconds
    yield f"{config.env.id}: {proposal.shows}. The lookahead queries {proposal.model}."
    if proposal.why:
        yield f"Why no other: {proposal.why}."
    yield (
        f"Measured at depth {config.search.depth}: {proposal.price}. Then the whole training of "
        f"{config.total_steps:,} steps takes about {_duration(training)}, as long as episodes stay as they are."
    )


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.2g} minutes" if seconds < 5400 else f"{seconds / 3600:.2g} hours"


def to_json(proposal: Proposal, path: Path) -> dict[str, Any]:
    """Return what was found as plain values."""
    return {"file": str(path)} | asdict(replace(proposal, config=None)) | {"config": plain(proposal.config)}  # type: ignore[arg-type]


def write(path: Path, proposal: Proposal, *, overwrite: bool) -> None:
    """Write the file, unless there is one by now that is not to be replaced."""
    if files.kind(path) is not None and not overwrite:
        raise PgtsError(f"{path} exists by now: give --overwrite to replace it, or another name by -o")
    files.replace(path, commented(proposal.config, describe(proposal)).encode())
