"""Every kind of search serves the algorithm."""

import math

import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent import make_world
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.config import load
from pgts_torch.errors import PgtsError
from pgts_torch.experiment.run import build
from pgts_torch.models import TabularModel
from pgts_torch.search import mcts
from pgts_torch.seeding import stream
from pgts_torch.tabular import exact

LEFT = {"type": "softmax", "init": {"type": "biased", "action": 0, "probability": 0.99}}
ALPHA_ZERO = {
    "type": "mcts",
    "simulations": 12,
    "root": "rule",
    "rule": "puct",
    "prior": "policy",
    "backup": "mean",
}
SEARCHES = [
    "auto",
    {"type": "expectimax", "max_width": 3},
    {"type": "sampled", "samples": 2},
    {"type": "mcts", "simulations": 12, "merge": False},
]


def trained(search, depth: int) -> float:
    model = PGTS(
        "pgts/Ladder-v0",
        depth=depth,
        search=search,
        policy=LEFT,
        critic="exact",
        update={"type": "softmax", "step_size": 10.0},
        num_envs=8,
        horizon={"type": "fixed", "length": 30},
    ).learn(6_000)
    return exact.evaluate(model.mdp, model.policy.table()).J / exact.optimal(model.mdp).J


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("search", SEARCHES, ids=str)
def test_every_search_climbs_the_ladder_that_a_shallow_one_cannot(search):
    assert trained(search, 4) > 0.95
    assert trained(search, 2) < 0.05


@pytest.mark.parametrize("critic", ["exact", "network"])
@pytest.mark.parametrize("search", SEARCHES, ids=str)
def test_a_model_in_float32_serves_every_search_and_a_critic_of_either_dtype(search, critic, monkeypatch):
    class SingleWorld(TabularWorld):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.model = TabularModel(self.mdp, dtype=torch.float32)

    monkeypatch.setattr(make_world, "TabularWorld", SingleWorld)
    model = PGTS("pgts/Random-v0", depth=2, search=search, critic=critic, num_envs=4, seed=3)
    assert model.iterate().look.q_BA.dtype == torch.float32
    assert {"exact": torch.float64, "network": torch.float32}[critic] == model.critic.dtype


@pytest.mark.parametrize("search", SEARCHES, ids=str)
def test_a_lookahead_does_not_depend_on_what_was_looked_at_before(search):
    model = PGTS("pgts/Random-v0", depth=2, search=search, num_envs=4, seed=3)
    model.iterate()
    first = model.lookahead(torch.tensor([0, 3])).q_BA
    model.lookahead(torch.tensor([1, 2, 4]), depth=1)
    torch.testing.assert_close(model.lookahead(torch.tensor([0, 3])).q_BA, first, rtol=0, atol=1e-12)


@pytest.mark.parametrize("search", [*SEARCHES, ALPHA_ZERO], ids=str)
def test_a_model_is_saved_with_its_search_and_trains_on_alike(search, tmp_path):
    made = PGTS("pgts/Random-v0", depth=2, search=search, num_envs=4, seed=3)
    made.iterate()
    made.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt")
    torch.testing.assert_close(loaded.iterate().look.q_BA, made.iterate().look.q_BA, rtol=0, atol=0)


@pytest.mark.parametrize("search", SEARCHES, ids=str)
def test_every_search_has_a_limit_of_memory(search):
    description = {"type": search} if isinstance(search, str) else search
    with pytest.raises(PgtsError, match=r"the limit is 9\.31e-08 GiB"):
        PGTS("pgts/Ladder-v0", depth=2, search={**description, "max_bytes": 100}, num_envs=2).iterate()
    PGTS("pgts/Ladder-v0", depth=2, search={**description, "max_bytes": 100_000}, num_envs=2).iterate()


def test_the_prior_of_the_policy_is_that_of_the_policy_as_it_is_now():
    model = PGTS("pgts/Random-v0", depth=3, search=ALPHA_ZERO, num_envs=4, seed=3)
    roots, table = torch.arange(model.mdp.num_states), TabularModel(model.mdp)

    def direct() -> torch.Tensor:
        options = {name: value for name, value in ALPHA_ZERO.items() if name not in ("type", "prior")}
        pi_SA, critic = model.policy.table(), model.critic
        leaf = {f"{critic.target}_leaf": critic.v if critic.target == "v" else critic.q}
        return mcts(table, roots, depth=3, **leaf, **options, prior=lambda s: pi_SA[s]).q_BA

    before = model.lookahead(roots).q_BA
    assert torch.equal(before, direct())
    model.iterate()
    assert torch.equal(model.lookahead(roots).q_BA, direct())
    model.policy.logits_SA[:, 0] += 5.0
    changed = model.lookahead(roots).q_BA
    assert torch.equal(changed, direct())
    assert not torch.equal(changed, before)


def test_the_tree_search_of_a_configuration_is_that_with_the_same_options():
    options = {("kind" if name == "type" else name): str(value) for name, value in ALPHA_ZERO.items()}
    arguments = [word for name, value in options.items() for word in (f"--search.{name}", value)]
    configured = build(load(None, ["--env.id", "pgts/Random-v0", "--search.depth", "3", *arguments]))
    roots = torch.arange(configured.mdp.num_states)
    given, default = (
        PGTS("pgts/Random-v0", depth=3, search=search) for search in (ALPHA_ZERO, {"type": "mcts", "simulations": 12})
    )
    assert str(configured.search) == str(given.search)
    assert torch.equal(configured.lookahead(roots).q_BA, given.lookahead(roots).q_BA)
    assert not torch.equal(default.lookahead(roots).q_BA, given.lookahead(roots).q_BA)


def test_samples_prove_nothing_but_a_narrow_search_does():
    def certificate(search) -> float:
        return PGTS("pgts/Ladder-v0", depth=6, search=search, policy=LEFT, critic="exact").iterate().certificate

    full, narrow = certificate("expectimax"), certificate({"type": "expectimax", "max_width": 1})
    mdp = PGTS("pgts/Ladder-v0", policy=LEFT).mdp
    missing = exact.optimal(mdp).J - exact.evaluate(mdp, PGTS("pgts/Ladder-v0", policy=LEFT).policy.table()).J
    assert missing <= full <= narrow < math.inf
    assert certificate("sampled") == math.inf


@pytest.mark.usefixtures("unchecked_shapes")
@pytest.mark.parametrize("share", ["level", "search"])
def test_a_sampled_lookahead_tells_its_standard_error(share):
    model = PGTS("FrozenLake-v1", depth=2, search={"type": "sampled", "samples": 4, "share": share}, seed=5)
    assert model.iterate().noise > 0
    v_S = torch.linspace(0, 1, 16, dtype=torch.float64)
    looks = [
        model.search(torch.arange(16), depth=2, v_leaf=lambda s: v_S[s], generator=stream(n, "noise"))
        for n in range(200)
    ]
    spread = float(torch.stack([look.q_BA for look in looks]).var(0).mean().sqrt())
    # Rather too large than too small, because what a level inherits varies with the samples and with what follows them.
    assert 0.9 * spread < sum(look.noise for look in looks) / len(looks) < 1.5 * spread


@pytest.mark.parametrize(
    ("search", "message"),
    [
        ("breadth", "search.kind is 'breadth'; it must be auto, expectimax, mcts or sampled"),
        ({"type": "auto", "max_width": 3}, "search.max_width does not belong to search.kind auto"),
        ({"type": "mcts", "share": "level"}, "search.share does not belong to search.kind mcts"),
        ({"type": "mcts", "samples": 0}, "samples is 0"),
        ({"type": "expectimax", "prior": "policy"}, "search.prior does not belong to search.kind expectimax"),
    ],
)
def test_an_unknown_search_or_option_is_refused(search, message):
    with pytest.raises(PgtsError, match=message):
        PGTS("pgts/Ladder-v0", search=search)
