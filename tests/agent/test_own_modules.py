"""Networks of the caller's own: what they are given, that they learn as ours do, and what is refused."""

import functools
import os
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from pgts_torch import PGTS
from pgts_torch.agent.components import components
from pgts_torch.agent.evaluate import evaluate
from pgts_torch.agent.gradients import Forward
from pgts_torch.agent.iteration import Batch
from pgts_torch.agent.networks import Network, make_trunk
from pgts_torch.agent.neural_updates import GradientUpdate
from pgts_torch.config import load
from pgts_torch.errors import Failed, NotFinite, PgtsError
from pgts_torch.options import MLP, Gradient, NetworkValues, OwnModule
from pgts_torch.seeding import stream
from tests.agent.kinds import CELLS, KINDS
from tests.agent.modules import (
    MAKES_NONE,
    Attention,
    Features,
    Forgetful,
    Frozen,
    Plain,
    Recurrent,
    Wrong,
    deep,
    makes_nothing,
)
from tests.agent.test_spaces import seen

pytestmark = pytest.mark.usefixtures("unchecked_shapes")

VECTORS = spaces.Box(-9, 9, (3,), np.float32)
SHORT: dict[str, Any] = {"num_envs": 2, "horizon": {"type": "fixed", "length": 15}, "depth": 1, "search": "expectimax"}
PARTS = spaces.Tuple([spaces.Box(0, 255, (6, 5, 2), np.uint8), spaces.Discrete(4)])


def network(make: Any, space: spaces.Space = VECTORS, *, outputs: int = 2, seed: int = 0, **options: Any) -> Network:
    generator = stream(seed, "network")
    own = OwnModule(make=make, **options)
    trunk = make_trunk(own, space, generator=generator, num_outputs=outputs)
    return Network(trunk, outputs, gain=0.5, generator=generator)


def rows(count: int, space: spaces.Space = VECTORS) -> torch.Tensor:
    size = 3 if space is VECTORS else 61
    row_ND = torch.rand(count, size, generator=stream(1, "rows"))
    return row_ND if space is VECTORS else torch.cat([(row_ND[:, 1:] * 255).floor(), (row_ND[:, :1] * 4).floor()], 1)


def trained(**options: Any) -> PGTS:
    model = PGTS("CartPole-v1", **SHORT | options)
    for _ in range(2):
        model.iterate()
    return model


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_a_module_is_called_as_it_is_and_has_the_gradients_of_autograd():
    net, twin = network(deep), network(deep)
    module, x_ND = twin.trunk.layers[0].module, rows(6)
    assert torch.equal(net.outputs(x_ND), module(x_ND))
    down_ND = torch.randn(6, 2, generator=stream(0, "down"))
    expected = torch.autograd.grad(module(x_ND), list(module.parameters()), down_ND)
    made = Forward(net, net.encode(x_ND))
    assert all(map(torch.equal, made.gradients(down_ND), expected))
    assert [piece.shape for piece in Forward(net, x_ND[:0]).gradients(down_ND[:0])] == [p.shape for p in net.weights]


def test_its_factory_is_given_the_space_of_its_inputs_and_a_call_an_input_for_each_part():
    net = network(Attention, PARTS, outputs=3)
    row_ND = rows(4, PARTS)
    image_N = row_ND[:, :60].reshape(4, 6, 5, 2).permute(0, 3, 1, 2) / 255
    number_N = torch.nn.functional.one_hot(row_ND[:, 60].long(), 4).float()
    module = net.trunk.layers[0].module
    assert (module.image.in_channels, module.number.in_features) == (2, 4)
    torch.testing.assert_close(net.outputs(row_ND), module(image_N, number_N).detach(), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_given_every_kind_of_observation_with_images_as_such_and_all_else_in_its_shape(kind):
    space, observe, *_ = KINDS[kind]
    observations = seen(space)
    row_N = torch.stack([observations.encode(observe(cell)) for cell in range(CELLS)])
    net = network(Plain, observations.space)
    assert len(net.outputs(row_N).unique(dim=0)) == CELLS
    shapes = [(part.n,) if isinstance(part, spaces.Discrete) else part.shape for part in components(observations.space)]
    images = [shape[-1:] + shape[:-1] for shape in shapes if len(shape) == 3]
    found = net.trunk.encoder.shapes
    assert len(found) == len(shapes)
    assert [shape for shape in found if len(shape) == 3 and "frame" not in kind] == images
    if kind in ("a board", "four dimensions", "bits in two dimensions"):
        assert found == shapes


def test_tied_frozen_and_unused_weights_are_trained_frozen_and_left_alone():
    net = network(Attention, PARTS, outputs=3)
    frozen, unused = (
        next(iter(part.parameters())) for part in (net.trunk.layers[0].module.number, net.trunk.layers[0].module.unused)
    )
    assert not any(weight is frozen for weight in net.weights)
    found = Forward(net, net.encode(rows(4, PARTS))).gradients(torch.ones(4, 3))
    by_weight = dict(zip(map(id, net.weights), found, strict=True))
    assert len(by_weight) == len(net.weights)
    assert not by_weight[id(unused)].any()
    assert any(piece.any() for piece in found)
    assert {name for name in net.plain_state() if "tied" in name or "number" in name}


def test_weights_are_from_the_seed_and_global_generators_stay_as_they_are():
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()  # noqa: NPY002
    one, same_seed, other = (network(Plain, seed=seed).plain_state() for seed in (0, 0, 1))
    assert torch.equal(before[0], torch.get_rng_state())
    assert before[1] == np.random.get_state()[1].tolist()  # noqa: NPY002
    assert same(one, same_seed)
    assert not same(one, other)
    assert all(value.dtype == torch.float32 for value in one.values() if value.is_floating_point())


def test_under_another_default_dtype_it_computes_in_float32(monkeypatch):
    expected = network(deep).outputs(rows(4))
    torch.set_default_dtype(torch.float64)
    try:
        found = network(deep).outputs(rows(4).float())
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.dtype == expected.dtype == torch.float32


@pytest.mark.parametrize("normalize", [False, True])
def test_observations_are_normalised_by_us_and_only_where_it_is_asked_for(normalize):
    net = network(deep, normalize=normalize)
    x_ND = rows(50) * 100 + 7
    net.trunk.encoder.absorb(x_ND)
    input_ND = net.encode(x_ND)
    module = net.trunk.layers[0].module
    assert torch.equal(net.outputs(x_ND), module(input_ND).detach())
    assert torch.equal(input_ND, x_ND) != normalize
    assert (float(input_ND.std(0, correction=0).mean()) == pytest.approx(1, abs=1e-3)) == normalize


WRONG: dict[str, str] = {
    "one row only": r"returned torch.float32 of the shape \(1, 2\) for 5 rows; it must .* of the shape \(5, 2\)",
    "one output more": r"of the shape \(5, 3\) for 5 rows",
    "one axis": r"of the shape \(5,\) for 5 rows",
    "float64": "returned torch.float64",
    "integers": "returned torch.int64",
    "an array": "returned a ndarray for 5 rows",
    "nothing": "returned a NoneType for 5 rows",
    "NaN": r"returned \[nan, .* must be finite",
    "infinity": r"returned \[-?inf, .* must be finite",
    "no gradient": "from which no gradient reaches its weights",
    "noise of torch": "returns something else each time",
    "noise of numpy": "returns something else each time",
    "a draw that changes nothing": "returns something else each time",
    "noise of its own": "returns something else each time",
    "dropout": "acts otherwise in training mode, as dropout",
    "batch norm": "acts otherwise in training mode, as dropout and batch norm do",
    "rows mix": "rows must not mix",
    "changes its input": "changes its inputs or its buffers",
    "counts calls": "changes its inputs or its buffers",
    "no weights": "has no weights that are trained",
    "complex weights": "has complex numbers in more",
    "state of its own": "has the state _extra_state, a dict; only tensors are saved",
    "weights that lie on each other": "cannot be moved .* and copied: RuntimeError: Error.* in loading",
    "layers in a list": "weights that are not its own, .*neither trained nor saved: keep layers in nn.ModuleList",
    "fails backward": "has no gradient: ",
    "sparse gradients": "has sparse gradients; .*sparse=False",
    "infinite buffer": "holds mask, which is not finite; register it as a buffer with persistent=False",
    "numbers on no device": "cannot be moved to the CPU in float32 and copied: NotImplementedError",
    "cannot be copied": "cannot be moved .* and copied",
    "fails when made": r"which cannot be made of Box\(.*\(3,\), float32\) and 2: RuntimeError: no such layer",
    "fails": r"failed with inputs of the shape \(5, 3\): RuntimeError: mat1",
}


@pytest.mark.parametrize("how", WRONG)
def test_a_module_that_is_no_function_of_each_row_alone_is_refused_by_its_name_and_what_it_does(how):
    with pytest.raises(PgtsError, match=f"tests.agent.modules:Wrong.*{WRONG[how]}"):
        network(Wrong, arguments={"how": how})
    assert network(Wrong, arguments={"how": "right"}).outputs(rows(2)).shape == (2, 2)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda space, num_outputs: None,
            "<lambda>; it must be a class, or a function that makes one, at the top level",
        ),
        (Plain(VECTORS, 2), "an object of the class Plain; it must be a class"),
        (functools.partial(Plain, width=3), "an object of the class partial"),
        (MAKES_NONE, "an object of the class partial"),
        (makes_nothing, "made a NoneType; it must be a torch.nn.Module"),
        ("tests.agent.modules:Missing", r"Missing, which .*AttributeError: .*modules\.py\) has no attribute 'Missing'"),
        ("no_such_module:Net", "no_such_module:Net, which cannot be made: ModuleNotFoundError"),
        (7, "7; it must be"),
    ],
)
def test_what_makes_no_module_is_refused_in_one_sentence(make, message):
    with pytest.raises(PgtsError, match=message) as caught:
        PGTS("CartPole-v1", policy=make, **SHORT)
    assert "\n" not in str(caught.value)


class ForPolicies(Plain):
    """It knows how many actions there are."""

    def __init__(self, space, num_outputs):
        super().__init__(space, 2)


def test_a_module_of_a_policy_that_cannot_be_its_critic_is_told_what_a_critic_needs():
    with pytest.raises(
        PgtsError, match=r"of the shape \(5, 1\) \(num_outputs is 1 for a critic, also where the policy"
    ):
        PGTS("CartPole-v1", policy=ForPolicies, **SHORT)
    PGTS("CartPole-v1", policy=ForPolicies, critic=Plain, **SHORT).iterate()


@pytest.mark.parametrize("given", [{"policy": Plain, "critic": Plain}, {"policy": "tests.agent.modules:Plain"}])
def test_a_policy_and_a_critic_may_be_given_as_a_class_or_by_its_name(given, tmp_path):
    model = trained(**given)
    assert model.options.policy == OwnModule(make="tests.agent.modules:Plain")
    assert model.options.critic == NetworkValues(network=model.options.policy)
    model.save(tmp_path / "model.pt")
    with pytest.raises(PgtsError, match=r"names 'tests.agent.modules:Plain' as its (policy|critic); that imports"):
        PGTS.load(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", trust_imports=True)
    for one in (model, loaded):
        one.iterate()
    assert same(model.policy.state_dict(), loaded.policy.state_dict())
    assert same(model.critic.state_dict()["network"], loaded.critic.state_dict()["network"])


def test_a_critic_of_ones_own_may_stand_beside_a_policy_of_ours():
    model = trained(policy="mlp", critic=deep)
    assert isinstance(model.options.policy, MLP)
    assert model.options.critic.network == OwnModule(make="tests.agent.modules:deep")
    wide = PGTS("CartPole-v1", **SHORT, policy="mlp", critic={"make": Plain, "arguments": {"width": 5}})
    assert wide.options.critic.network == OwnModule(make="tests.agent.modules:Plain", arguments={"width": 5})
    table = PGTS("pgts/Ladder-v0", policy="softmax", critic=deep, depth=1, num_envs=2).learn(200)
    assert table.options.policy.type == "softmax"


def test_a_saved_model_whose_module_is_missing_is_refused_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nets_of_mine.py").write_text("from tests.agent.modules import Plain\nclass Net(Plain):\n    pass\n")
    PGTS("CartPole-v1", policy="nets_of_mine:Net", **SHORT).save("model.pt")
    for text, why in (("", "has no attribute 'Net'"), (None, "No module named 'nets_of_mine'")):
        sys.modules.pop("nets_of_mine", None)
        if text is None:
            os.remove("nets_of_mine.py")
        else:
            (tmp_path / "nets_of_mine.py").write_text(text)
        with pytest.raises(Failed, match=rf"nets_of_mine:Net, which cannot be made: .*{why}"):
            PGTS.load("model.pt", trust_imports=True)


def test_weights_of_another_width_are_refused_and_change_nothing():
    state = trained(policy={"make": Plain, "arguments": {"width": 4}}).state_dict()
    model = PGTS("CartPole-v1", policy={"make": Plain, "arguments": {"width": 5}}, **SHORT)
    before = model.policy.state_dict()
    with pytest.raises(PgtsError, match=r"the saved state of policy does not fit: .*of shape \(4,\)"):
        model.load_state_dict(state)
    assert same(before, model.policy.state_dict())


def test_features_are_shared_by_policy_and_critic_and_outputs_are_not():
    policy = {"type": "module", "make": Features, "head": True}
    model = trained(policy=policy, critic={"network": "shared"})
    assert model.critic.network.trunk is model.policy.network.trunk
    assert model.policy.network.head.in_features == 8
    assert trained(policy=policy).critic.network.trunk is not model.policy.network.trunk
    with pytest.raises(PgtsError, match=r"critic.network.type is shared; policy.make .* set policy.head to true"):
        trained(policy=Plain, critic={"network": "shared"})


def test_of_features_that_stay_as_they_are_the_last_layer_alone_is_trained():
    model = PGTS("CartPole-v1", **SHORT, policy={"make": Frozen, "head": True})
    before = model.policy.state_dict()
    model.iterate()
    after = model.policy.state_dict()
    moved = {name for name in after if not torch.equal(before[name], after[name])}
    assert moved == {"head.weight", "head.bias"}
    with pytest.raises(PgtsError, match="has no weights that are trained"):
        network("tests.agent.modules:Wrong", arguments={"how": "no weights"})


@pytest.mark.parametrize(
    "given", [deep, "tests.agent.modules:deep", {"type": "module", "make": Features, "head": True}]
)
def test_a_gaussian_policy_may_be_of_such_a_network(given, tmp_path):
    options = SHORT | {"policy": {"type": "gaussian", "network": given}, "actions": 3}
    model = PGTS("Pendulum-v1", **options)
    model.iterate()
    assert model.options.critic.network == model.options.policy.network
    model.save(tmp_path / "model.pt")
    with pytest.raises(PgtsError, match=r"names 'tests.agent.modules:.*' as its policy; that imports"):
        PGTS.load(tmp_path / "model.pt")
    loaded = PGTS.load(tmp_path / "model.pt", trust_imports=True)
    for one in (model, loaded):
        one.iterate()
    assert same(model.policy.state_dict(), loaded.policy.state_dict())
    if given is deep:
        with pytest.raises(PgtsError, match=r"shared; policy.network.make .* set policy.network.head to true"):
            PGTS("Pendulum-v1", **options, critic={"network": "shared"})


def test_an_update_that_is_not_finite_is_taken_back():
    model, observation_ND = trained(policy=Plain), torch.rand(20, 4, generator=stream(2, "rows"))
    before = model.policy.state_dict()
    batch = Batch(observation_ND, torch.full((20, 2), 1e38) * torch.tensor([1.0, -1.0]), torch.ones(20))
    with pytest.raises(NotFinite, match=r"gradient|loss"):
        GradientUpdate(Gradient(learning_rate=1.0))(model.policy, batch, generator=stream(0, "update"))
    assert same(before, model.policy.state_dict())


class Pictures(gymnasium.Env):
    """Pays for the first action in a bright image."""

    observation_space = spaces.Dict({"image": spaces.Box(0, 255, (6, 5, 2), np.uint8), "at": spaces.Discrete(4)})
    action_space = spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float((action == 0) == self.bright)
        return self._seen(), reward, bool(self.np_random.random() < 0.1), False, {}

    def _seen(self) -> dict[str, Any]:
        self.bright = bool(self.np_random.random() < 0.5)
        return {"image": np.full((6, 5, 2), 200 if self.bright else 20, np.uint8), "at": self.np_random.integers(4)}


def test_attention_over_parts_of_observations_learns_which_action_pays():
    model = PGTS(
        Pictures,
        policy=Attention,
        depth=0,
        estimator="sampled",
        num_envs=8,
        observation_keys=["image", "at"],
        update={"type": "ppo", "learning_rate": 3e-3},
        horizon={"type": "fixed", "length": 32},
    )

    def reward() -> float:
        rollout = model.iterate().experience
        return float(rollout.of_visits(rollout.reward_TB).mean())

    first = reward()
    model.learn(8 * 32 * 8)
    assert reward() > max(0.8, first + 0.2)


class Cue(gymnasium.Env):
    """A cue, seen in the first of four steps alone, says which action is right in the last one."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.cue, self.steps = int(self.np_random.integers(2)), 0
        return self._seen(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        is_over = self.steps == 4
        return self._seen(), float(is_over and action == self.cue), is_over, False, {}

    def _seen(self) -> Any:
        return np.array([2 * self.cue - 1 if self.steps == 0 else 0, self.steps / 4], np.float32)


def stacked() -> gymnasium.Env:
    """The four latest observations, which are part of what the lookahead restores."""
    return gymnasium.wrappers.FrameStackObservation(Cue(), 4)


@pytest.mark.filterwarnings("ignore:.*attributes are pickled")
@pytest.mark.parametrize(("make", "policy", "solves"), [(stacked, Recurrent, True), (Cue, "mlp", False)])
def test_a_recurrent_policy_over_the_latest_observations_remembers_under_a_lookahead(make, policy, solves):
    model = PGTS(make, policy=policy, depth=1, num_envs=8, horizon={"type": "fixed", "length": 4}, search="expectimax")
    for _ in range(12):
        model.iterate()
    greedy = evaluate(model, episodes=40, seed=5).episodic_return.mean
    assert greedy == 1 if solves else 0.2 < greedy < 0.8


def test_a_module_with_a_memory_of_its_own_is_refused_with_the_way_out():
    with pytest.raises(PgtsError, match=r"the same function .*gymnasium\.wrappers\.FrameStackObservation"):
        PGTS("CartPole-v1", policy=Forgetful, **SHORT)


def test_a_configuration_and_the_command_line_name_it(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("policy: {make: 'tests.agent.modules:Plain', arguments: {width: 3}}\nenv: {id: CartPole-v1}")
    flags = ["--policy", "tests.agent.modules:Plain", "--policy.arguments.width", "3", "--env.id", "CartPole-v1"]
    expected = OwnModule(make="tests.agent.modules:Plain", arguments={"width": 3})
    for config in (load(path), load(None, flags)):
        assert config.policy == expected
        assert PGTS(**config.arguments()).policy.network.trunk.layers[0].module.outputs.in_features == 3
    config = load(None, ["--critic.network", "tests.agent.modules:Plain", "--critic.network.arguments.width", "3"])
    assert config.critic.network == expected
    with pytest.raises(PgtsError, match=r"policy\.make is missing; it must be MODULE:NAME"):
        load(None, ["--policy.type", "module"])
    with pytest.raises(PgtsError, match=r"critic\.network\.arguments holds inf; numbers must be finite"):
        load(None, ["--critic.network", "a:b", "--critic.network.arguments.x", ".inf"])
