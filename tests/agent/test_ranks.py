"""Processes that train together: what they exchange, and that their update is that of one with the whole batch."""

import os
import time
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import pytest
import torch
from gymnasium import spaces
from torch import distributed

from pgts_torch import PGTS
from pgts_torch.agent import visit
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.ranks import Draws, Ranks, checksum, joined_ranks, present_ranks
from pgts_torch.agent.rollout import Rollout
from pgts_torch.errors import NotFinite, PgtsError, RankLost
from pgts_torch.seeding import stream
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
    "network, simulator": partial(PGTS, Counted, depth=1, update=GRADIENT, **SMALL),
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
}


def tensors(state: Any) -> list[torch.Tensor]:
    """All tensors of nested mappings, in the order of names."""
    if isinstance(state, torch.Tensor):
        return [state.double()]
    return [each for name in sorted(state) for each in tensors(state[name])] if isinstance(state, dict) else []


def plain(experience: Rollout, model: PGTS) -> dict[str, Any]:
    """Episodes without their numbers of states: what stands for a state is what another process is told of it."""
    columns = {each.name: getattr(experience, each.name) for each in fields(experience) if each.name != "state_UB"}
    if model.dyna is not None:  # the states of a learned model are what is observed
        states = experience.observation_UB.flatten(0, 1)
    else:
        states = None if experience.state_UB is None else model.world.export(experience.state_UB.flatten())
    return {"columns": columns, "states": states}


def trained(make: Callable[..., PGTS], *, num_envs: int, iterations: int = 3) -> dict[str, Any]:
    model, seen = make(num_envs=num_envs, seed=3), []
    for _ in range(iterations):
        iteration = model.iterate()
        about = {"depth": iteration.depth, "gap": float(iteration.gap_N.sum()), "certificate": iteration.certificate}
        seen.append({"experience": plain(iteration.experience, model), **about})
    return {
        "seen": seen,
        "policy": model.policy.state_dict(),
        "critic": model.critic.state_dict(),
        "dyna": learned(model),
        "counts": counts(model),
    }


def learned(model: PGTS) -> dict[str, Any]:
    """A learned model, and what is replayed."""
    return {} if model.dyna is None else model.dyna.state_dict()


def counts(model: PGTS) -> tuple[int, int, int]:
    return model.num_iterations, model.num_env_steps, model.num_model_calls


def replayed(
    make: Callable[..., PGTS], seen: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, within: dict[str, float]
) -> PGTS:
    """One process that is given the episodes of all others, and what it makes of them at the depths that they took.

    An adaptive depth may be larger in several processes than alone, never smaller: each has asked about a part of the
    states, so they bound what is missing less tightly, and the gap falls short of it more often.
    """
    model, chooser = make(num_envs=4, seed=3), make(num_envs=4, seed=3)
    alone = Ranks.draws

    def draws(self: Ranks, seed: int, number: int, device: torch.device) -> Draws:
        """With the random numbers that several ranks have in common."""
        common = stream(seed, "iteration", number, "common", device=device)
        return replace(alone(self, seed, number, device), common=common)

    for each in seen:

        def given(world: Any, *rest: Any, each=each, **options: Any) -> Rollout:
            columns, states = each["experience"]["columns"], each["experience"]["states"]
            state_UB = None if states is None else world.adopt(states).view(columns["observation_UB"].shape[:2])
            return Rollout(**columns, state_UB=state_UB)

        monkeypatch.setattr(visit, "rollout", given)
        if model.episodes is not None:
            monkeypatch.setattr(model.episodes, "collect", partial(given, model.world))
        monkeypatch.setattr(Ranks, "draws", draws)
        if chooser.depth_choice is not None and len(chooser.depth_choice.depths) > 1:
            chooser.load_state_dict(model.state_dict())
            assert chooser.iterate().depth <= each["depth"]
            model.depth_choice.depths = [each["depth"]]
        iteration = model.iterate()
        assert iteration.depth == each["depth"]
        assert float(iteration.gap_N.sum()) == pytest.approx(each["gap"], **within, nan_ok=True)
        assert iteration.certificate <= each["certificate"] + 1e-9  # each rank has asked about a part of the states
    return model


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [2, 3])
def test_ranks_make_the_update_of_one_process_with_the_whole_batch(kind, size, monkeypatch):
    make = KINDS[kind]
    # Tables are float64; networks are float32, and what they say of a state depends on its batch in the last bits.
    within = {"rel": 1e-4, "abs": 1e-5} if "network" in kind else {"rel": 0.0, "abs": 1e-12}
    first, *others = on_ranks(size, lambda: trained(make, num_envs=4))
    for other in others:
        assert checksum(other["policy"]) == checksum(first["policy"])
        assert other["counts"] == first["counts"]
    widths = [each["experience"]["columns"]["reward_TB"].shape[1] for each in first["seen"]]
    assert "learned" in kind or widths == [4] * len(widths)  # episodes that go on have a column for each part
    alone = replayed(make, first["seen"], monkeypatch, within)
    assert counts(alone)[:2] == first["counts"][:2]
    parts = {"policy": alone.policy.state_dict(), "critic": alone.critic.state_dict(), "dyna": learned(alone)}
    for part, state in parts.items():
        for mine, theirs in zip(tensors(state), tensors(first[part]), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=within["rel"], atol=within["abs"])
    start = make(num_envs=4, seed=3)
    assert checksum(start.policy.state_dict()) != checksum(first["policy"])


def test_ranks_make_different_episodes(monkeypatch):
    [first, _] = on_ranks(2, lambda: trained(KINDS["network, torch dynamics"], num_envs=4, iterations=1))
    state_UBD = first["seen"][0]["experience"]["states"].view(-1, 4, 4)
    assert len(state_UBD[0].unique(dim=0)) == 4


def test_the_lookahead_is_shared_out():
    def asked() -> tuple[int, int]:
        model = PGTS("CartPole-v1", depth=1, num_envs=4, update=GRADIENT, **SMALL)
        model.iterate()
        assert model.search is not None
        return model.search.model_calls, model.num_model_calls

    (mine, total), (theirs, the_same) = on_ranks(2, asked)
    assert total == the_same == mine + theirs
    assert abs(mine - theirs) < 0.2 * total


def test_more_ranks_than_states_leave_some_without_a_lookahead():
    make = partial(PGTS, "pgts/Ladder-v0", depth=2, horizon={"type": "fixed", "length": 1})
    answers = on_ranks(3, lambda: trained(make, num_envs=3, iterations=2))
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
