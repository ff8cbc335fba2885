"""Processes that train together: what they exchange, and that their update is that of one with the whole batch."""

import copy
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import partial
from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import distributed

from pgts_torch import PGTS
from pgts_torch.agent import dyna, explorer, visit
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.optimisers import Optimiser
from pgts_torch.agent.rollout import Rollout
from pgts_torch.errors import NotFinite, PgtsError, RankLost
from pgts_torch.models.base import Experience
from pgts_torch.models.ensemble import EnsembleModel
from pgts_torch.options import Ensemble
from pgts_torch.ranks import ALONE, Ranks, checksum, joined_ranks, present_ranks
from pgts_torch.seeding import stream
from tests.agent.modules import Plain
from tests.forks import launched, on_ranks
from tests.models.corridors import Corridor

pytestmark = pytest.mark.usefixtures("unchecked_shapes")


class Counted(Corridor):
    """Its actions are counted from 0, and nothing slips."""

    def __init__(self) -> None:
        super().__init__(slip=0)
        self.action_space = spaces.Discrete(2)

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict]:
        return super().step(action + 5)


SMALL = {"policy": {"type": "mlp", "hidden": [8]}, "horizon": {"type": "fixed", "length": 12}}
GRADIENT = {"type": "gradient", "learning_rate": 0.01}
FEW = {"type": "uniform", "updates_per_step": 0.1, "starts": 4, "length": 5}
KINDS: dict[str, Callable[..., PGTS]] = {
    "softmax table": partial(PGTS, "pgts/Ladder-v0", depth=3),
    "projected table, adaptive depth": partial(
        PGTS, "pgts/Random-v0", depth="adaptive", policy="simplex", update={"type": "projected", "step_size": 0.1}
    ),
    "uniform weight": partial(PGTS, "pgts/Grid-v0", update={"type": "mirror", "state_weight": "uniform"}),
    "geometric horizon": partial(PGTS, "pgts/Ladder-v0", depth=2, horizon="geometric"),
    "network, torch dynamics": partial(PGTS, "CartPole-v1", depth=1, update=GRADIENT, **SMALL),
    "table, few roots": partial(PGTS, "pgts/Grid-v0", depth=2, max_roots=9),
    "network, few roots": partial(PGTS, "CartPole-v1", depth=1, update=GRADIENT, max_roots=20, **SMALL),
    "network, simulator": partial(PGTS, Counted, depth=1, update=GRADIENT, **SMALL),
    "network of the caller's own": partial(
        PGTS, "CartPole-v1", depth=1, update=GRADIENT, **SMALL | {"policy": {"make": Plain, "normalize": True}}
    ),
    "network, learned model": partial(
        PGTS,
        "CartPole-v1",
        depth=1,
        model={"type": "ensemble", "members": 2, "hidden": [8], "first_updates": 5},
        policy=SMALL["policy"],
        horizon={"type": "steps", "length": 5, "first": 9},
        replay=FEW,
    ),
    "learned table": partial(
        PGTS, "CliffWalking-v1", depth=8, model="counts", horizon={"type": "steps", "length": 20}, replay=FEW
    ),
    "network, no model": partial(PGTS, "CartPole-v1", depth=0, estimator="sampled", update=GRADIENT, **SMALL),
    "episodes that go on": partial(
        PGTS,
        "CartPole-v1",
        depth=0,
        estimator="sampled",
        update={"type": "ppo", "minibatch_size": 16, "num_epochs": 2},
        policy=SMALL["policy"],
        horizon={"type": "steps", "length": 12},
    ),
}


@pytest.fixture
def in_float64(monkeypatch):
    """All networks in float64, where a sum in another order is as good as the same."""
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def made(make: Callable[..., PGTS]) -> PGTS:
    """A training whose networks are in the default dtype."""
    model = make(num_envs=5, seed=3)
    slow = None if model.dyna is None else model.dyna.policy
    for part in (model.policy, model.critic, slow) if torch.get_default_dtype() == torch.float64 else ():
        for name in ("network", "_target_network"):
            if (network := getattr(part, name, None)) is not None:
                network.double()
    return model


def tensors(state: Any) -> list[torch.Tensor]:
    """All tensors of nested mappings, in the order of names."""
    if isinstance(state, torch.Tensor):
        return [state.double()]
    return [each for name in sorted(state) for each in tensors(state[name])] if isinstance(state, dict) else []


def plain(rollout: Rollout, model: PGTS) -> dict[str, Any]:
    """Episodes of one process, with states in a form that another one can number."""
    columns = {each.name: getattr(rollout, each.name) for each in fields(rollout) if each.name not in NOT_PLAIN}
    if model.dyna is not None:  # in worlds with replay here the states are what is observed
        states = rollout.observation_UB.flatten(0, 1)
    else:
        states = None if rollout.state_UB is None else model.world.export(rollout.state_UB.flatten())
    return {"columns": columns, "states": states}


NOT_PLAIN = "state_UB", "totals"


def joined(parts: list[dict[str, Any]], world: Any) -> Rollout:
    """One rollout with the episodes of all processes: those of each begin in the row after the last one of those
    before. So visits are in the order of processes, as they are when these divide minibatches."""
    lengths = [len(part["columns"]["alive_TB"]) for part in parts]
    numbered = [None if part["states"] is None else world.adopt(part["states"]) for part in parts]

    def placed(x_TB: torch.Tensor, before: int, extra: int) -> torch.Tensor:
        after = sum(lengths) + extra - before - len(x_TB)
        return torch.cat([x_TB[:1].expand(before, *x_TB.shape[1:]), x_TB, x_TB[-1:].expand(after, *x_TB.shape[1:])])

    columns: dict[str, Any] = {}
    for name, like in parts[0]["columns"].items():
        if name == "finished":
            columns[name] = None if like is None else tuple(each for part in parts for each in part["columns"][name])
        elif like is None:
            columns[name] = None
        elif name == "begins_B":
            columns[name] = torch.cat([part["columns"][name] for part in parts])
        else:
            extra = name.endswith("_UB")
            pieces = [placed(part["columns"][name], sum(lengths[:rank]), extra) for rank, part in enumerate(parts)]
            columns[name] = torch.cat(pieces, 1)
    for rank in range(len(parts)):
        first = sum(part["columns"]["alive_TB"].shape[1] for part in parts[:rank])
        own = slice(first, first + parts[rank]["columns"]["alive_TB"].shape[1])
        outside = torch.ones(sum(lengths), dtype=torch.bool)
        outside[sum(lengths[:rank]) : sum(lengths[: rank + 1])] = False
        for name in ("alive_TB", "weight_TB"):
            columns[name][outside, own] = 0
    states = [
        placed(state_N.view(length + 1, -1), sum(lengths[:rank]), 1)
        for rank, (state_N, length) in enumerate(zip(numbered, lengths, strict=True))
        if state_N is not None
    ]
    return Rollout(**columns, state_UB=torch.cat(states, 1) if states else None)


def trained(make: Callable[..., PGTS], *, iterations: int = 3) -> dict[str, Any]:
    """What a process makes, and all that it has learned."""
    model, seen = made(make), list[dict[str, Any]]()
    rollouts, models = list[dict[str, Any]](), list[dict[str, Any]]()
    imagine = dyna.imagine

    def imagined(*args: Any, **options: Any) -> Rollout:
        rollouts.append(plain(rollout := imagine(*args, **options), model))
        return rollout

    dyna.imagine = explorer.imagine = imagined  # in this process, which ends here
    if isinstance(model.world.model, EnsembleModel):
        learn = model.dyna.learn

        def learned(*args: Any) -> dict[str, float]:
            losses = learn(*args)
            models.append(copy.deepcopy(model.world.model.state_dict()))
            return losses

        model.dyna.learn = learned
    for _ in range(iterations):
        iteration = model.iterate()
        gap = iteration.ranks.totals("a test", iteration.gap_N @ iteration.weight_N.to(iteration.gap_N))[0]
        about = {"depth": iteration.depth, "gap": gap, "certificate": iteration.certificate}
        about["losses"] = {k: v for k, v in iteration.losses.items() if not k.startswith("model_")}
        seen.append({"experience": plain(iteration.experience, model), **about})
    parts = {"policy": model.policy.state_dict(), "critic": model.critic.state_dict()}
    return {"seen": seen, "imagined": rollouts, "models": models, "counts": counts(model), **parts}


def counts(model: PGTS) -> tuple[int, int, int]:
    return model.num_iterations, model.num_env_steps, model.num_model_calls


def replayed(
    make: Callable[..., PGTS], all_made: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, within: float = math.inf
) -> PGTS:
    """One process that is given the episodes of all, and what it makes of them at the depths that they took.

    An adaptive depth may be larger in several processes than alone, never smaller: each has asked about a part of the
    states, so they bound what is missing less tightly, and the gap falls short of it more often.
    """
    model, chooser = made(make), made(make)
    alone = Draws.of
    imagined = iter(list(zip(*(each["imagined"] for each in all_made), strict=True)))

    def draws(ranks: Ranks, seed: int, number: int, device: torch.device) -> Draws:
        """With the random numbers that several ranks have in common."""
        common = stream(seed, "iteration", number, "common", device=device)
        return replace(alone(ranks, seed, number, device), common=common)

    def update(self: Draws, number: int) -> Draws:
        common = stream(self.seed, "iteration", self.number, "update", number, "common")
        return replace(self, common=common, _common_names=("iteration", self.number, "update", number))

    def learn(*_: Any) -> dict[str, float]:
        states = [each["models"][model.num_iterations] for each in all_made]
        model.world.model.load_state_dict(copy.deepcopy(states[0]))
        model.dyna.replay.num_added = sum(state["replay"]["num_added"] for state in states)
        return {}

    def values(self: Rollout, v: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Also where episodes do not begin in the first row."""
        nobody = torch.zeros_like(self.alive_TB[:1])
        needed_UB = torch.cat([self.alive_TB, nobody]) | torch.cat([nobody, self.alive_TB])
        v_UB = torch.zeros_like(needed_UB, dtype=self.reward_TB.dtype)
        v_UB[needed_UB] = v(self.observation_UB[needed_UB]).to(v_UB)
        return v_UB[:-1], v_UB[1:]

    monkeypatch.setattr(Draws, "of", draws)
    monkeypatch.setattr(Draws, "update", update)
    monkeypatch.setattr(Rollout, "values", values)
    for module in (dyna, explorer):
        monkeypatch.setattr(module, "imagine", lambda world, *_, **__: joined(next(imagined), world))
    if isinstance(model.world.model, EnsembleModel):
        model.dyna.learn = learn
    for parts in zip(*(each["seen"] for each in all_made), strict=True):
        each = parts[0]

        def given(world: Any, *_: Any, parts=parts, **__: Any) -> Rollout:
            return joined([part["experience"] for part in parts], world)

        monkeypatch.setattr(visit, "rollout", given)
        if model.episodes is not None:
            monkeypatch.setattr(model.episodes, "collect", partial(given, model.world))
        if chooser.depth_choice is not None and len(chooser.depth_choice.depths) > 1:
            chooser.load_state_dict(model.state_dict())
            assert chooser.iterate().depth <= each["depth"]
            model.depth_choice.depths = [each["depth"]]
        iteration = model.iterate()
        if within == math.inf:
            continue
        assert iteration.depth == each["depth"]
        assert float(iteration.gap_N @ iteration.weight_N.to(iteration.gap_N)) == pytest.approx(
            each["gap"], rel=1e3 * within, nan_ok=True
        )
        losses = {name: value for name, value in iteration.losses.items() if not name.startswith("model_")}
        assert losses == pytest.approx(each["losses"], rel=1e3 * within, abs=10 * within)
        assert iteration.certificate <= each["certificate"] + 1e-9  # each rank has asked about a part of the states
    return model


def groups() -> Iterator[Any]:
    """Each kind in two processes; in three, which divide nothing evenly, one of each form in the short form."""
    for size, kind in itertools.product([2, 3], KINDS):
        short = size == 2 or kind in ("projected table, adaptive depth", "network, simulator", "learned table")
        yield pytest.param(size, kind, marks=[] if short else pytest.mark.long)


@pytest.mark.parametrize(("size", "kind"), [*groups()])
def test_ranks_make_the_update_of_one_process_with_the_whole_batch(kind, size, monkeypatch, request):
    make, within = KINDS[kind], 1e-12
    if "learned model" in kind:
        within = 1e-4  # the states of an ensemble are float32
    else:
        request.getfixturevalue("in_float64")
    first, *others = all_made = on_ranks(size, lambda: trained(make))
    for other in others:
        assert checksum(other["policy"]) == checksum(first["policy"])
        assert checksum(other["critic"]) == checksum(first["critic"])
        assert other["counts"] == first["counts"]
    alone = replayed(make, all_made, monkeypatch, within)
    assert counts(alone)[:2] == first["counts"][:2]
    for part, state in {"policy": alone.policy.state_dict(), "critic": alone.critic.state_dict()}.items():
        for mine, theirs in zip(tensors(state), tensors(first[part]), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=within, atol=within)
    start = made(make)
    assert checksum(start.policy.state_dict()) != checksum(first["policy"])


@pytest.mark.usefixtures("in_float64")
def test_a_part_of_the_episodes_makes_another_update(monkeypatch):
    make = KINDS["network, torch dynamics"]
    all_made = on_ranks(2, lambda: trained(make, iterations=1))
    other = replayed(make, [all_made[0]] * 2, monkeypatch)
    pairs = zip(tensors(other.policy.state_dict()), tensors(all_made[0]["policy"]), strict=True)
    assert max(float((mine - theirs).abs().max()) for mine, theirs in pairs) > 1e-6


@pytest.mark.usefixtures("in_float64")
def test_an_ensemble_learns_on_ranks_as_one_process_does_from_the_steps_of_all(monkeypatch):
    random = torch.Generator().manual_seed(0)
    observation_ND, change_ND = (torch.rand(60, 3, generator=random) for _ in range(2))
    number_N = torch.arange(60)
    discount_N = torch.where(number_N % 10 == 7, 0.0, 0.9)
    columns = [observation_ND, number_N % 2, change_ND[:, 0], discount_N, observation_ND + change_ND, discount_N > 0]
    parts = 1

    def sampled(high: int, shape: tuple[int, int], **_: Any) -> torch.Tensor:
        """Where one process samples for two, what both sample from their halves of the steps."""
        own = torch.arange(shape[0] * shape[1] // parts).view(shape[0], -1) * 7 % (high // parts)
        return torch.cat([own + part * (high // parts) for part in range(parts)], 1)

    def learned(ranks: Ranks, own: slice) -> tuple[dict[str, Any], dict[str, float]]:
        options = Ensemble(members=2, hidden=[8], first_updates=6, minibatch_size=16)
        model = EnsembleModel(3, 2, gamma=0.9, options=options)
        losses = model.learn(Experience(*(column[own] for column in columns), ranks), generator=stream(0, "learn"))
        state = model.state_dict()
        return {name: state[name] for name in ("weights", "moments")}, losses

    monkeypatch.setattr(torch, "randint", sampled)
    monkeypatch.setattr(torch, "poisson", lambda mean, **_: mean.clone())
    made_of = on_ranks(2, lambda: learned(ranks := present_ranks(), slice(30 * ranks.rank, 30 * ranks.rank + 30)))
    parts = 2
    (alone, losses), (half, _) = learned(ALONE, slice(60)), learned(ALONE, slice(30))
    for state, found in made_of:
        assert found["loss"] == pytest.approx(losses["loss"], rel=1e-12)
        for mine, theirs in zip(state["weights"], alone["weights"], strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
    assert (half["weights"][0] - alone["weights"][0]).abs().max() > 1e-4


def test_ranks_make_different_episodes(monkeypatch):
    made_of = on_ranks(2, lambda: trained(KINDS["network, torch dynamics"], iterations=1))
    starts = [each["seen"][0]["experience"]["columns"]["observation_UB"][0] for each in made_of]
    assert len(torch.cat(starts).unique(dim=0)) == 5


def test_the_lookahead_is_shared_out():
    def asked() -> tuple[int, int]:
        model = PGTS("CartPole-v1", depth=1, num_envs=4, update=GRADIENT, **SMALL)
        model.iterate()
        assert model.search is not None
        return model.search.model_calls, model.num_model_calls

    (mine, total), (theirs, the_same) = on_ranks(2, asked)
    assert total == the_same == mine + theirs
    assert abs(mine - theirs) < 0.2 * total


def test_a_gradient_step_is_one_exchange_and_the_others_do_not_grow_with_the_length_of_episodes():
    def work(length: int) -> tuple[int, int, int]:
        horizon = {"type": "fixed", "length": length}
        model = PGTS("MountainCar-v0", depth=1, num_envs=4, policy=SMALL["policy"], horizon=horizon)
        exchange, steps, step = model.ranks.exchange, list[int](), Optimiser.step

        def counted(self: Optimiser, parameters: Any, gradients: Any, *rest: Any) -> torch.Tensor:
            steps.append(sum(map(torch.numel, gradients)))
            return step(self, parameters, gradients, *rest)

        Optimiser.step = counted  # in this process, which ends here
        assert exchange is not None
        before = exchange.num_calls, exchange.num_bytes
        model.iterate()
        in_steps = sum(4 * (size + 1) for size in steps)  # float32, and the loss
        return len(steps), exchange.num_calls - before[0] - len(steps), exchange.num_bytes - before[1] - in_steps

    [(few, calls, bytes_), _], [(many, other_calls, other_bytes), _] = (
        on_ranks(2, lambda length=length: work(length)) for length in (20, 60)
    )
    assert 0 < few < many
    assert calls == other_calls
    assert abs(bytes_ - other_bytes) < 32  # what is pickled has shorter and longer numbers


def test_more_ranks_than_states_leave_some_without_a_lookahead():
    make = partial(PGTS, "pgts/Ladder-v0", depth=2, horizon={"type": "fixed", "length": 1})
    answers = on_ranks(3, lambda: trained(make, iterations=2))
    assert len({checksum(each["policy"]) for each in answers}) == 1


def test_ranks_that_are_loaded_go_on_as_if_they_had_never_stopped(tmp_path):
    def ending(stop: int) -> tuple[int, tuple[int, int, int]]:
        model = PGTS("pgts/Grid-v0", depth=2, num_envs=5, update={"type": "mirror", "step_size": 1.0})
        for _ in range(stop):
            model.iterate()
        model.save(tmp_path / "model.pt")
        model = PGTS.load(tmp_path / "model.pt")
        for _ in range(4 - stop):
            model.iterate()
        return checksum(model.policy.state_dict()), counts(model)

    assert on_ranks(2, lambda: ending(2)) == on_ranks(2, lambda: ending(4))


def test_learning_ends_where_one_rank_wants_it():
    def steps() -> int:
        model = PGTS("pgts/Ladder-v0", num_envs=2)
        rank = model.ranks.rank
        model.learn(10**6, callback=lambda model, _: rank == 0 or model.num_iterations < 3)
        return model.num_iterations

    assert on_ranks(2, steps) == [3, 3]


def test_policies_that_differ_are_noticed():
    def mistake() -> str:
        model = PGTS("pgts/Ladder-v0", num_envs=2)
        if model.ranks.rank == 1:
            model.policy.logits_SA[0, 0] += 1e-15  # type: ignore[attr-defined]
        with pytest.raises(PgtsError) as caught:
            model.learn(1000)
        return str(caught.value)

    assert (
        on_ranks(2, mistake)
        == ["the ranks have different policies: do they run on different hardware or versions?"] * 2
    )


def test_fewer_episodes_than_ranks_are_refused():
    def mistake() -> str:
        with pytest.raises(PgtsError) as caught:
            PGTS("pgts/Ladder-v0", num_envs=1)
        return str(caught.value)

    assert on_ranks(2, mistake) == ["num_envs is 1; 2 processes need at least as many"] * 2


def test_an_error_in_one_rank_is_raised_in_all_with_its_number():
    def mistake() -> tuple[str, str, int | None]:
        ranks = present_ranks()

        def make() -> int:
            if ranks.rank == 1:
                raise NotFinite("the reward is nan", what="reward")
            return 0

        with pytest.raises(NotFinite) as caught:
            ranks.gather("a test", make)
        return str(caught.value), caught.value.what, caught.value.rank

    assert on_ranks(2, mistake) == [("the reward is nan", "reward", 1)] * 2


def test_a_lost_rank_is_an_error():
    def missed() -> str:
        ranks = present_ranks()
        ranks.gather("a test", lambda: None)
        if ranks.rank == 1:
            return "gone"
        with pytest.raises(RankLost) as caught:
            ranks.gather("a test", lambda: None)
        return str(caught.value)

    assert on_ranks(2, missed) == ["rank 0 of 2 has lost another one, asking for a test", "gone"]


def test_ranks_at_different_exchanges_say_so():
    def mistake() -> str:
        ranks = present_ranks()
        with pytest.raises(PgtsError) as caught:
            ranks.gather("bread" if ranks.rank else "wine", lambda: None)
        return str(caught.value)

    first, second = on_ranks(2, mistake)
    assert first == "rank 0 asks for wine, rank 1 for bread: they are out of step"
    assert second == "rank 1 asks for bread, rank 0 for wine: they are out of step"


def test_an_evaluation_is_made_once_for_all(tmp_path):
    def evaluated() -> tuple[float, bool]:
        torch.manual_seed(os.getpid())
        noise = float(torch.rand(()))
        model = PGTS("pgts/Ladder-v0", num_envs=2, horizon={"type": "fixed", "length": 5})
        watch = EvalCallback(every=1, episodes=1, best_path=tmp_path / "best.pt")
        score = watch.evaluator
        watch.evaluator = lambda *args, **options: replace(score(*args, **options), episodes=int(1e6 * noise))
        model.learn(30, callback=watch)
        return watch.history[-1].evaluation.episodes, (tmp_path / "best.pt").exists()

    first, second = on_ranks(2, evaluated)
    assert first == second


def test_a_critic_that_samples_when_queried_samples_differently_in_each_rank():
    def values() -> list[float]:
        model = PGTS(
            "pgts/Random-v0", depth=0, num_envs=2, critic={"type": "rollout", "samples": 1}, horizon="geometric"
        )
        model.iterate()
        return model.critic.v(torch.arange(5)).tolist()

    first, second = on_ranks(2, values)
    assert first != second


def test_the_parts_of_all_ranks_are_the_whole():
    things = torch.arange(7)
    for size in range(1, 10):
        ranks = [Ranks(rank, size) for rank in range(size)]
        assert torch.equal(torch.cat([each.part(things) for each in ranks]), things)
        assert sum(each.count(7) for each in ranks) == 7
        assert [each.leads for each in ranks] == [True] + [False] * (size - 1)
    assert Ranks().gather("a test", lambda: "alone") == ["alone"]
    assert replace(Ranks(), size=2).names == ("rank", 0)


def test_a_checksum_sees_every_bit():
    state = {"a": torch.zeros(3), "b": {"c": torch.ones(2, dtype=torch.float64)}}
    other = {"a": torch.zeros(3), "b": {"c": torch.tensor([1, 1 + 2**-52], dtype=torch.float64)}}
    assert checksum(state) != checksum(other)
    assert checksum(state) == checksum({"b": state["b"], "a": state["a"]})


def test_a_process_leaves_the_group_only_when_all_have_connected(tmp_path, monkeypatch):
    connect = distributed.init_process_group

    def connect_slowly(*args: Any, **kwargs: Any) -> None:
        connect(*args, **kwargs)
        if os.environ["RANK"] == "1":
            time.sleep(0.5)
            (tmp_path / "connected").touch()

    def work() -> int:
        with joined_ranks("cpu"):
            pass
        return int(not (tmp_path / "connected").exists())

    monkeypatch.setattr(distributed, "init_process_group", connect_slowly)
    assert launched(2, work) == [0, 0]
