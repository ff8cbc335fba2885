"""Action masks: an environment in which an illegal action is an error is trained in, evaluated and resumed."""

import itertools
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from pgts_torch import PGTS
from pgts_torch.agent.components import legal_in, with_mask
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.neural import NetworkPolicy
from pgts_torch.agent.neural_updates import GradientUpdate, PPOUpdate
from pgts_torch.agent.target_updates import CMPOUpdate, NetworkMirrorUpdate
from pgts_torch.agent.updates import Update
from pgts_torch.errors import Failed, MissingModel, ModelMismatch, PgtsError
from pgts_torch.models import SimulatorModel
from pgts_torch.models.masks import ActionMasks, masks_in
from pgts_torch.options import MLP
from pgts_torch.seeding import stream
from pgts_torch.tabular import exact
from tests.agent.masked import ENVIRONMENTS, GAMMA, LEGAL_SA, MAKERS, SEARCHES, ByMethod, Strict, legal_mdp
from tests.support import same_values

SHORT: dict[str, Any] = {
    "num_envs": 2, "horizon": {"type": "fixed", "length": 5}, "gamma": GAMMA, "policy": {"type": "mlp", "hidden": [8]},
}  # fmt: skip
SAMPLED: dict[str, Any] = {"depth": 0, "estimator": "sampled"}
Q: dict[str, Any] = {"critic": {"type": "network", "target": "q", "target_period": 2}}

UPDATES: dict[str, dict[str, Any]] = {
    "gradient": {"type": "gradient", "entropy_coef": 0.1},
    "ppo": {"type": "ppo", "entropy_coef": 0.1},
    "ppo, normalised": {"type": "ppo", "normalize_advantage": True, "target_kl": 0.01},
    "cmpo": {"type": "cmpo"},
    "mirror": {"type": "mirror", "temperature": 0.01},
}


def trained(env: Any = ByMethod, **options: Any) -> PGTS:
    """Two iterations: an illegal action would be an error."""
    model, before = PGTS(env, **(SHORT | options)), Strict.taken + ByMethod.taken
    model.iterate()
    model.iterate()
    assert Strict.taken + ByMethod.taken > before
    return model


def probs_by_state(model: PGTS) -> np.ndarray:
    """pi(.|s) of the five states that are no end, seen as numbers."""
    row_NA = model.world.observations.with_legal(np.arange(5), LEGAL_SA.astype(bool))
    return model.policy.probs(torch.from_numpy(row_NA)).numpy()


# No illegal step


@pytest.mark.filterwarnings("ignore:.*attributes are pickled")
@pytest.mark.parametrize(
    ("env", "search"),
    [*itertools.product(ENVIRONMENTS, ["expectimax", "none"]), *itertools.product(["info", "observation"], SEARCHES)],
)
def test_no_illegal_action_is_taken_in_training_evaluation_and_after_loading(env, search, tmp_path):
    make = lambda: TimeLimit(ENVIRONMENTS[env](), 6)  # noqa: E731
    model = trained(make, **SEARCHES[search])
    model.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=make)
    assert same_values(model.state_dict(), loaded.state_dict())
    model.iterate()
    loaded.iterate()
    assert same_values(model.state_dict(), loaded.state_dict())
    scores = [evaluate(one, episodes=3, deterministic=sure) for one in (model, loaded) for sure in (True, False)]
    assert scores[:2] == scores[2:]


@pytest.mark.parametrize(("update", "search"), [*itertools.product(UPDATES, ["m = 0", "none"])])
@pytest.mark.parametrize("critic", [{}, Q])
def test_illegal_actions_have_probability_0_after_every_update(update, search, critic):
    if search == "none" and (update in ("cmpo", "mirror") or critic):
        return  # which need the advantages of all actions, or a lookahead
    model = trained(update=UPDATES[update], **SEARCHES[search], **critic)
    probs_SA = probs_by_state(model)
    assert (probs_SA[LEGAL_SA == 0] == 0).all()
    assert (probs_SA[LEGAL_SA == 1] > 0).all()


@pytest.mark.parametrize("search", [search for search in SEARCHES if search != "none"])
def test_a_critic_of_q_is_searched_with(search):
    assert (trained(**SEARCHES[search], **Q).num_model_calls > 0) == (search != "m = 0")


@pytest.mark.parametrize(
    "options",
    [
        {
            "replay": {"type": "uniform", "starts": 4, "length": 4},
            "horizon": {"type": "steps", "length": 20},
            "depth": 1,
        },
        {"critic": {"type": "network", "network": "shared"}},
    ],
)
def test_episodes_that_go_on_imagined_ones_and_shared_networks_take_no_illegal_action(options):
    for says in MAKERS:  # their environments raise an error after an illegal action
        assert trained(MAKERS[says], **options).num_env_steps > 0


@pytest.mark.parametrize("says", MAKERS)
def test_environments_that_are_given_as_a_vector_are_masked(says):
    envs = SyncVectorEnv([MAKERS[says]] * 2, autoreset_mode=AutoresetMode.DISABLED)
    assert trained(envs, num_envs=None, **SEARCHES["m = 0"]).num_env_steps > 0
    wrapped = RecordEpisodeStatistics(SyncVectorEnv([MAKERS[says]] * 2, autoreset_mode=AutoresetMode.DISABLED))
    assert trained(wrapped, num_envs=None, **SAMPLED).num_env_steps > 0


@pytest.mark.parametrize("says", MAKERS)
def test_episodes_that_go_on_are_resumed_without_an_illegal_action(says, tmp_path):
    model = trained(MAKERS[says], **SAMPLED, horizon={"type": "steps", "length": 4})
    model.save(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", env=MAKERS[says])
    model.iterate()
    loaded.iterate()
    assert same_values(model.state_dict(), loaded.state_dict())


def test_without_masks_the_same_training_fails():
    with pytest.raises(Failed, match=r"action \d is not legal in state"):
        trained(action_masks="off", **SAMPLED)


# Values


@pytest.mark.parametrize("env", ["action_masks()", "info", "observation"])
def test_a_lookahead_has_the_values_of_the_mdp_without_illegal_actions(env):
    model = PGTS(ENVIRONMENTS[env], **(SHORT | {"depth": 40, "search": "expectimax"}))
    state_N = model.iterate().state_N
    look, optimum = model.lookahead(state_N), exact.optimal(legal_mdp())
    states = model.world.observe(state_N)[:, 0].tolist()
    legal_NA = torch.from_numpy(LEGAL_SA[states] == 1)
    expected_NA = torch.where(legal_NA, optimum.q_SA[states], -torch.inf)
    torch.testing.assert_close(look.q_BA, expected_NA, rtol=0, atol=1.01 * 0.9**40 * 20)
    naive = torch.tensor(9.0)  # what an illegal action would give at once
    assert not (look.q_BA >= naive).any()


def test_a_policy_learns_the_best_of_the_legal_actions():
    model = PGTS(lambda: Strict("info"), **(SHORT | {"depth": 4, "num_envs": 8}))
    model.learn(1200)
    optimum = exact.optimal(legal_mdp())
    assert (
        probs_by_state(model).argmax(-1)[:4].tolist()
        == optimum.q_SA[:4].where(torch.from_numpy(LEGAL_SA[:4] == 1), -torch.inf).argmax(-1).tolist()
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: GradientUpdate(GradientUpdate().options.model_copy(update={"entropy_coef": 0.1})),
        PPOUpdate,
        CMPOUpdate,
        NetworkMirrorUpdate,
    ],
)
def test_an_update_is_that_of_a_policy_without_the_illegal_action(make):
    box = spaces.Box(-1, 1, (3,), np.float32)
    masked, plain = (
        NetworkPolicy(space, count, MLP(hidden=[8])) for space, count in ((with_mask(box, 3), 3), (box, 2))
    )
    with torch.no_grad():
        plain.network.weights[0].copy_(masked.network.weights[0])
        plain.network.head.weight.copy_(masked.network.head.weight[:2])
    row_ND = torch.randn(40, 3, generator=stream(0, "rows"))
    legal_NA = torch.tensor([1.0, 1.0, 0.0]).expand(40, 3)
    advantage_NA = torch.randn(40, 2, generator=stream(0, "advantages"), dtype=torch.float64)
    advantage_NA -= (plain.probs(row_ND) * advantage_NA).sum(-1, keepdim=True)
    weight_N = torch.full((40,), 1 / 40, dtype=torch.float64)
    never_NA = torch.cat([advantage_NA, torch.full((40, 1), -torch.inf, dtype=torch.float64)], 1)
    untouched = masked.network.head.weight[2].clone()

    def moved(update: Update, policy: NetworkPolicy, observation_N: torch.Tensor, advantage: torch.Tensor) -> dict:
        return update(policy, Batch(observation_N, advantage, weight_N), generator=stream(0, "update"))

    losses = moved(make(), masked, torch.cat([row_ND, legal_NA], 1), never_NA)
    assert losses == pytest.approx(moved(make(), plain, row_ND, advantage_NA), rel=1e-4, abs=1e-7)
    torch.testing.assert_close(masked.network.head.weight[:2], plain.network.head.weight, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(masked.network.weights[0], plain.network.weights[0], rtol=1e-4, atol=1e-6)
    assert torch.equal(masked.network.head.weight[2], untouched)


# What is said


def test_predict_takes_a_legal_action_and_needs_the_mask():
    model = trained(**SAMPLED)
    masks = LEGAL_SA.astype(bool)
    for sure in (True, False):
        assert all(masks[s, int(model.predict(s, action_mask=masks[s], deterministic=sure))] for s in range(5))
        assert masks[range(5), model.predict(np.arange(5), action_mask=LEGAL_SA, deterministic=sure)].all()
    with pytest.raises(PgtsError, match=r"Method has action masks: give the one of this observation, as action_masks"):
        model.predict(0)
    for wrong in ([1, 0], [0, 2, 1], "111", [[1, 0, 0]] * 2, [0, 0, 0], [np.nan, 1, 1]):
        with pytest.raises(PgtsError, match=r"must be a vector of 3|no action is legal|have the shape"):
            model.predict(0, action_mask=wrong)
    plain = PGTS("CartPole-v1", **(SHORT | SAMPLED))
    with pytest.raises(PgtsError, match="trained without action masks"):
        plain.predict(np.zeros(4, np.float32), action_mask=[1, 0])


class Says(Strict):
    """Its masks after two steps are what a function makes of them."""

    change: Any = staticmethod(lambda mask: mask)
    steps = 0

    def __init__(self):
        super().__init__("info")

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        return super().reset(seed=seed)

    def step(self, action):
        *step, info = super().step(action)
        self.steps += 1
        mask = type(self).change(info["action_mask"]) if self.steps == 2 else info["action_mask"]
        return *step, {} if mask is None else {"action_mask": mask}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            np.zeros_like,
            r"failed in step 1 of the episode with the seed \d+: no action is legal by info\['action_mask'\]",
        ),
        (lambda mask: None, r"in step 1 .* seed \d+: there is no info\['action_mask'\], which was there before"),
        (lambda mask: mask[:2], r"is array\(\[\d, \d\].*\); it must be a vector of 3 booleans"),
        (lambda mask: 5 * mask, "it must be a vector of 3 booleans, or of 0 and 1"),
        (lambda mask: "all", "it must be a vector of 3 booleans"),
        (lambda mask: [[1], [1, 0]], "it must be a vector of 3 booleans"),
    ],
)
def test_a_mask_that_is_none_is_an_error_with_step_and_seed(change, message):
    class Wrong(Says):
        pass

    Wrong.change = staticmethod(change)
    with pytest.raises(Failed, match=message):
        trained(Wrong, **SAMPLED, horizon={"type": "fixed", "length": 9}, num_envs=4)


def test_masks_in_steps_alone_and_where_they_must_be_are_errors():
    class Late(Says):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=seed)[0], {}

    with pytest.raises(Failed, match=r"info has 'action_mask' after a step and had none after a reset"):
        trained(Late, **SAMPLED, policy={"type": "mlp", "hidden": [8]}, seed=3)
    with pytest.raises(PgtsError, match="action_masks is 'on'; CartPole-v1 has no method"):
        PGTS("CartPole-v1", action_masks="on", **SAMPLED)


def test_a_learned_model_and_repeated_actions_are_refused_with_masks():
    with pytest.raises(MissingModel, match="'ensemble', which does not learn which actions are legal"):
        PGTS(lambda: ByMethod(vector=True), model="ensemble")
    with pytest.raises(PgtsError, match="action_repeat is 2, and action_masks"):
        PGTS(ByMethod, **SHORT, action_repeat=2)


def test_masks_that_differ_in_one_state_contradict_the_simulator():
    class Moody(ByMethod):
        """Once it is moody, the first action is legal in state 3 after every second step only."""

        moody = False

        def action_masks(self):
            mask = super().action_masks()
            mask[0] &= not (self.moody and self.s == 3 and type(self).taken % 2)
            return mask

    model = PGTS(Moody, **(SHORT | {"depth": 3, "num_envs": 8}))
    model.iterate()
    Moody.moody = True
    with pytest.raises(ModelMismatch, match=r"allows the actions \[.*\] where it allowed \[.*\] before, in state"):
        model.learn(400)


def test_an_environment_without_a_hash_is_restored_and_masked():
    class Equal(ByMethod):
        def __eq__(self, other):
            return self is other

    with pytest.raises(TypeError, match="unhashable"):
        hash(Equal())
    model = PGTS(Equal, **(SHORT | {"depth": 1}))
    model.iterate()
    assert model.num_model_calls > 0


def test_a_simulator_never_steps_an_illegal_action():
    env = Strict("info")
    _, info = env.reset(seed=0)
    masks = masks_in(env, range(3), info)
    model = SimulatorModel(lambda: Strict("info"), gamma=GAMMA, masks=masks)
    state_N = torch.tensor([model.root(env, legal_A=masks.of(env, env.s, info))])
    for _ in range(4):
        outcomes = model.outcomes(state_N)
        legal_NA = torch.tensor(model.legal(state_N))
        assert torch.equal(outcomes.reward_NA > -torch.inf, legal_NA)
        state_N = outcomes.child_NAK[legal_NA & (outcomes.discount_NAK[..., 0] > 0)].unique()
    with pytest.raises(PgtsError, match=r"which actions are legal in state .* is not known"):
        model.outcomes(torch.tensor([model.number(model.snapshot(0)._replace(key=b"new"))]))


def test_predict_takes_a_mask_from_its_observation():
    model = trained(MAKERS["observation"], **SAMPLED)
    assert model.world.observation_space == with_mask(spaces.Discrete(6), 3)  # masks are no input
    masks, own = LEGAL_SA.astype(bool), {"observation": np.arange(5), "action_mask": LEGAL_SA}
    assert masks[range(5), model.predict(own, deterministic=False)].all()
    assert masks[3, int(model.predict({"observation": 3, "action_mask": LEGAL_SA[3]}))]
    for given in (LEGAL_SA[4], LEGAL_SA[0]):  # what is given counts, whatever the observation says
        assert given[int(model.predict({"observation": 3, "action_mask": LEGAL_SA[3]}, action_mask=given))]
    with pytest.raises(PgtsError, match=r"has action masks: give the one of this observation, as observation\["):
        model.predict({"observation": 3})


class Shown(gymnasium.ObservationWrapper):
    """Shows an entry beside what is observed.

    Args:
        space, entry: its space, and what it is of an environment and its observation.
    """

    def __init__(self, env, space, entry):
        super().__init__(env)
        self.observation_space = spaces.Dict({"observation": env.observation_space, "action_mask": space})
        self.entry = entry

    def observation(self, observation):
        return {"observation": observation, "action_mask": self.entry(self.unwrapped, observation)}


def test_an_entry_of_observations_that_is_no_mask_is_seen():
    other = spaces.MultiBinary(4), spaces.Box(0, 2, (3,), np.int8), spaces.Discrete(3), spaces.MultiBinary((1, 3))
    legal = LEGAL_SA.astype(bool)
    for space, says in itertools.product(other, ("info", "method")):
        inner = (lambda: Strict("info")) if says == "info" else ByMethod
        make = lambda space=space, inner=inner: Shown(inner(), space, lambda *_: space.sample())  # noqa: E731
        model = trained(make, **SAMPLED)
        assert model.world.masks.source == says
        assert isinstance(model.world.observation_space, spaces.Tuple)
        seen = {"observation": 1, "action_mask": space.sample()}
        assert legal[1, int(model.predict(seen, action_mask=legal[1]))]


@pytest.mark.filterwarnings("ignore:.*has wrappers that are part of the model")
@pytest.mark.parametrize("search", ["none", "expectimax"])
def test_masks_that_a_wrapper_adds_to_observations_are_those_of_its_simulator_too(search):
    for entry in (lambda env, _: env._mask(), lambda _, seen: LEGAL_SA[min(seen, 4)] * (seen < 5)):
        make = lambda entry=entry: Shown(Strict("none"), spaces.MultiBinary(3), entry)  # noqa: E731
        assert trained(make, **SEARCHES[search]).world.masks.source == "observation"


def test_masks_of_several_numbers_have_an_entry_for_each_value():
    class Two(gymnasium.Env):
        action_space = spaces.MultiDiscrete([2, 3], start=[0, 5])
        observation_space = spaces.Box(0, 1, (1,), np.float32)
        form: Any = staticmethod(np.concatenate)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(1, np.float32), self.info()

        def info(self):
            return {"action_mask": self.form([np.array([True, False]), np.array([False, True, True])])}

        def step(self, action):
            assert action[0] == 0
            assert action[1] in (6, 7)
            return np.zeros(1, np.float32), float(action[1]), False, False, self.info()

    class Apart(Two):
        form = staticmethod(tuple)

    for make in (Two, Apart):
        model = PGTS(make, **(SHORT | SAMPLED))
        assert set(model.iterate().experience.action_TB.unique().tolist()) == {1, 2}
        assert isinstance(model.world.masks, ActionMasks)


def test_the_legal_actions_are_the_last_entries_of_a_row():
    model = PGTS(lambda: Strict("info"), **(SHORT | SAMPLED))
    batch = model.iterate()
    legal_NA = legal_in(model.world.observation_space, batch.observation_N)
    assert torch.equal(legal_NA, torch.from_numpy(LEGAL_SA == 1)[batch.observation_N[:, 0].long()])


def test_the_mask_of_taxi_is_advice_beside_its_table_and_binds_where_it_is_wanted(capsys):
    advised = PGTS("Taxi-v4", num_envs=1)
    assert advised.options.policy.type == "softmax"
    assert capsys.readouterr().err == ""
    bound = PGTS("Taxi-v4", **(SHORT | {"depth": 1, "action_masks": "on"}))
    experience = bound.iterate().experience
    legal_NA = legal_in(bound.world.observation_space, experience.observation_V)
    assert legal_NA.gather(1, experience.of_visits(experience.action_TB)[:, None]).all()
    assert not legal_NA.all()


def test_masks_in_info_are_said_once(capsys):
    PGTS(lambda: Strict("info"), **(SHORT | SAMPLED))
    assert capsys.readouterr().err.count("masked by info['action_mask']; action_masks 'off' ignores it") == 1
    PGTS(ByMethod, **(SHORT | SAMPLED))
    assert capsys.readouterr().err == ""


def test_masks_are_taken_by_the_name_that_sb3_contrib_gives_them():
    model = trained(**SAMPLED)
    own, other = np.arange(5), LEGAL_SA.astype(bool)
    actions, state = model.predict(own, state=None, episode_start=np.ones(5, bool), action_masks=other)
    assert state is None
    assert np.array_equal(actions, model.predict(own, action_mask=other))
    with pytest.raises(PgtsError, match="action_mask and action_masks are the same: give one of them"):
        model.predict(own, action_mask=other, action_masks=other)


@pytest.mark.parametrize("vector", [False, True])
def test_policies_with_masks_are_evaluated_by_sb3_contrib_as_its_own_are(vector):
    evaluation = pytest.importorskip("sb3_contrib.common.maskable.evaluation")
    monitor = pytest.importorskip("stable_baselines3.common.monitor")
    model = trained(lambda: ByMethod(vector=vector), **SAMPLED)
    env, other = (TimeLimit(ByMethod(vector=vector), 20) for _ in range(2))
    env.reset(seed=3)  # the generators go on from here, when they are reset without a seed
    other.reset(seed=3)
    found = evaluation.evaluate_policy(model, monitor.Monitor(env), n_eval_episodes=5, return_episode_rewards=True)
    returns = []
    for _ in range(5):
        total, over = 0.0, False
        observation, _ = other.reset()
        while not over:
            action = model.predict(observation, action_mask=other.unwrapped.action_masks())
            observation, reward, terminated, truncated, _ = other.step(action)
            total, over = total + reward, terminated or truncated
        returns.append(total)
    np.testing.assert_allclose(found[0], returns, rtol=1e-5)
