"""Exported policies: what they return is what `predict` and the policy return, bit for bit in torch."""

import json
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from torch import Tensor, nn

from pgts_torch import PGTS
from pgts_torch.agent import exporting
from pgts_torch.agent.policies import Policy
from pgts_torch.errors import PgtsError
from tests.agent.kinds import CELLS, KINDS, Corridor
from tests.agent.masked import LEGAL_SA, ByMethod
from tests.forks import PATIENCE
from tests.test_documents import PAGES, blocks

pytestmark = pytest.mark.usefixtures("unchecked_shapes")  # they would be checked of traced tensors, whose N is a symbol

SHORT: dict[str, Any] = {"num_envs": 2, "horizon": {"type": "fixed", "length": 4}, "depth": 1}
NETWORKS: dict[str, dict[str, Any]] = {
    "mlp": {"type": "mlp", "hidden": [8]},
    "cnn": {"type": "cnn", "channels": [4, 4], "hidden": [8]},
    "module": {"type": "module", "make": "tests.agent.modules:Plain"},
}


def trained(env: Any, **arguments: Any) -> PGTS:
    model = PGTS(env, **SHORT | arguments)
    model.iterate()
    return model


def inputs_of(model: PGTS, seen: Sequence[Any], masks: Any = None) -> dict[str, Tensor]:
    """Observations as the inputs of what is exported, by the notes that it has."""
    described = exporting.Exported(model.world, model.source, model.policy).examples()
    rows: dict[str, list[np.ndarray]] = {name: [] for name in described}
    for number, observation in enumerate(seen):
        for name, row in rows.items():
            part = observation
            for step in [] if name in ("observation", "action_mask") else name.removeprefix("observation.").split("."):
                part = part[int(step) if step.isdecimal() else step]
            row.append(np.asarray(masks[number] if name == "action_mask" else part))
    return {name: torch.from_numpy(np.stack(row)).to(described[name].dtype) for name, row in rows.items()}


def in_torch(model: PGTS, folder: Path, given: dict[str, Tensor]) -> dict[str, Tensor]:
    model.export(folder / "policy.pt2")
    found: dict[str, Tensor] = torch.export.load(folder / "policy.pt2").module()(given)
    return found


def in_onnx(model: PGTS, folder: Path, given: dict[str, Tensor]) -> dict[str, Tensor]:
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    model.export(folder / "policy.onnx")
    session = runtime.InferenceSession(folder / "policy.onnx")
    found = session.run(None, {name: value.numpy() for name, value in given.items()})
    return {output.name: torch.from_numpy(value) for output, value in zip(session.get_outputs(), found, strict=True)}


def observed(kind: str) -> list[Any]:
    return [KINDS[kind].observe(cell) for cell in range(CELLS)]


def corridor(kind: str, network: str) -> PGTS:
    policy = dict(NETWORKS[network])
    if network != "module" and "Box" in str(KINDS[kind].space):
        policy["normalize"] = True
    return trained(lambda: TimeLimit(Corridor(kind), 10), policy=policy)


def short() -> list[Any]:
    """Every kind once, with each of its networks in the long form."""
    cases = []
    for number, (kind, (_, _, policies, _)) in enumerate(KINDS.items()):
        networks = [*policies, "module"]
        for each in networks:
            marks = [] if each == networks[number % len(networks)] else [pytest.mark.long]
            cases.append(pytest.param(kind, each, marks=marks))
    return cases


def same_actions(model: PGTS, seen: Sequence[Any], found: dict[str, Tensor], masks: Any = None) -> None:
    given: list[dict[str, Any]] = [{} if masks is None else {"action_mask": mask} for mask in masks or seen]
    wanted = np.stack([model.predict(one, **more) for one, more in zip(seen, given, strict=True)])
    np.testing.assert_allclose(found["action"].numpy(), wanted, rtol=1e-6, atol=1e-7)
    assert found["action"].dtype.is_floating_point == (wanted.dtype.kind == "f")


@pytest.mark.parametrize(("kind", "network"), short())
def test_a_network_over_every_kind_of_observation_is_exported_bit_for_bit(kind, network, tmp_path):
    model, seen = corridor(kind, network), observed(kind)
    found = in_torch(model, tmp_path, inputs_of(model, seen))
    wanted = model.policy.probs(torch.stack([model.world.encode(one) for one in seen]))
    assert torch.equal(found["probs"], wanted)
    assert len(wanted.unique(dim=0)) > 1
    same_actions(model, seen, found)


def test_a_table_is_exported_with_the_numbers_of_its_states_and_actions(tmp_path):
    model = PGTS("FrozenLake-v1", depth=4, num_envs=8, gamma=0.99).learn(500)
    given = {"observation": torch.arange(16)}
    found = in_torch(model, tmp_path, given)
    assert torch.equal(found["probs"], model.policy_table())
    same_actions(model, range(16), found)
    assert model.export(tmp_path / "policy.pt2")["inputs"] == {"observation": "int64 (batch)"}


class Shifted(gymnasium.ObservationWrapper):
    """States counted from 5."""

    def __init__(self) -> None:
        super().__init__(gymnasium.make("FrozenLake-v1"))
        self.observation_space = spaces.Discrete(16, start=5)

    def observation(self, observation):
        return observation + 5


def test_a_table_of_counted_states_takes_them_as_the_environment_numbers_them(tmp_path):
    model = trained(Shifted, model="counts", horizon={"type": "steps", "length": 40})
    found = in_torch(model, tmp_path, {"observation": torch.arange(5, 21)})
    same_actions(model, range(5, 21), found)
    assert torch.equal(found["probs"], model.policy_table())


def test_a_gaussian_policy_is_exported_with_the_squashed_mean_as_its_action(tmp_path):
    model = trained("Pendulum-v1", policy="gaussian", actions=4)
    seen = [np.array([np.cos(x), np.sin(x), 5 * x], np.float32) for x in (-0.4, 0.0, 1.2)]
    given = inputs_of(model, seen)
    found = in_torch(model, tmp_path, given)
    normals = model.policy.normals(given["observation"])
    assert torch.equal(found["mean"], normals.mean_NX)
    assert torch.equal(found["std"], normals.std_NX)
    same_actions(model, seen, found)
    assert found["action"].shape == (3, 1)
    assert float(found["action"].abs().max()) <= 2


def test_numbered_actions_come_out_in_the_form_of_the_environment(tmp_path):
    model = trained("Pendulum-v1", actions_per_dimension=3, policy="mlp")
    seen = [np.array([np.cos(x), np.sin(x), 8 * x], np.float32) for x in np.linspace(-1, 1, 20)]
    found = in_torch(model, tmp_path, inputs_of(model, seen))
    assert found["action"].dtype == torch.float32
    assert found["action"].shape == (20, 1)
    same_actions(model, seen, found)


def masked() -> tuple[PGTS, list[Any], list[Any]]:
    model = trained(lambda: ByMethod(vector=True), policy="mlp", seed=3)
    return model, [*np.eye(6, dtype=np.float32)[:5]], [*LEGAL_SA.astype(bool)]


def test_action_masks_are_an_input(tmp_path):
    model, seen, masks = masked()
    found = in_torch(model, tmp_path, inputs_of(model, seen, masks))
    assert ((found["probs"] > 0).numpy() == LEGAL_SA.astype(bool)).all()
    same_actions(model, seen, found, masks)
    free = torch.export.load(tmp_path / "policy.pt2").module()(inputs_of(model, seen, [np.ones(3, bool)] * 5))
    assert (free["probs"] > 0).all()


def test_images_that_a_model_represents_as_vectors_are_exported_with_its_network(tmp_path):
    fits = {"hidden": [8], "first_updates": 3, "updates_per_step": 0.1, "size": 4, "unroll": 2, "minibatch_size": 4}
    model = PGTS(
        lambda: TimeLimit(Corridor("an image"), 10),
        policy="mlp",
        depth=1,
        model={"type": "latent"} | fits,
        horizon={"type": "steps", "length": 10, "first": 60},
        replay={"updates_per_step": 0.05, "starts": 4, "length": 4},
    )
    model.iterate()
    seen = observed("an image")
    found = in_torch(model, tmp_path, inputs_of(model, seen))
    images = torch.stack([model.world.encode(one) for one in seen])
    torch.testing.assert_close(found["probs"], model.policy.probs(model.world.perceive(images)), rtol=0, atol=1e-6)
    same_actions(model, seen, found)


ONNX: dict[str, Any] = {
    "a table": lambda: (PGTS("FrozenLake-v1", depth=4, num_envs=8, gamma=0.99).learn(300), [*range(16)], None),
    "an image": lambda: (corridor("an image", "cnn"), observed("an image"), None),
    "dictionaries": lambda: (
        corridor("a dictionary of dictionaries and tuples", "mlp"),
        observed("a dictionary of dictionaries and tuples"),
        None,
    ),
    "masks": masked,
    "a gaussian policy": lambda: (
        trained("Pendulum-v1", policy="gaussian", actions=4),
        [np.array([0.5, 0.2, x], np.float32) for x in (-1, 0, 3)],
        None,
    ),
}


@pytest.mark.parametrize("case", [*ONNX, *(pytest.param(kind, marks=pytest.mark.long) for kind in KINDS)])
def test_onnx_computes_what_torch_does(case, tmp_path):
    model, seen, masks = ONNX[case]() if case in ONNX else (corridor(case, "module"), observed(case), None)
    given = inputs_of(model, seen, masks)
    found = in_onnx(model, tmp_path, given)
    wanted = exporting.Exported(model.world, model.source, model.policy)(given)
    assert [*found] == [*wanted]
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6)
    same_actions(model, seen, found, masks)


def test_a_program_of_other_weights_would_be_noticed(tmp_path):
    model = corridor("a vector", "mlp")
    seen = observed("a vector")
    found = in_torch(model, tmp_path, inputs_of(model, seen))
    model.iterate()
    assert not torch.equal(found["probs"], model.policy.probs(torch.stack([model.world.encode(one) for one in seen])))


def test_running_statistics_are_part_of_the_program(tmp_path):
    model = corridor("a vector", "mlp")
    assert model.policy.network.trunk.encoder.norm.count > 0
    seen = [10 * each for each in observed("a vector")]
    assert torch.equal(
        in_torch(model, tmp_path, inputs_of(model, seen))["probs"],
        model.policy.probs(torch.stack([model.world.encode(one) for one in seen])),
    )


def test_a_file_says_what_it_takes_and_gives(tmp_path):
    model, *_ = masked()
    said = model.export(tmp_path / "policy.pt2")
    assert said["inputs"] == {"observation": "float32 (batch, 6)", "action_mask": "bool (batch, 3)"}
    with zipfile.ZipFile(tmp_path / "policy.pt2") as archive:
        [name] = [name for name in archive.namelist() if name.endswith("exported by pgts_torch")]
        content = json.loads(archive.read(name))
    assert content["inputs"] == said["inputs"]
    assert content["outputs"] == said["outputs"] == {"probs": "float32 (batch, 3)", "action": "int64 (batch)"}


# What is refused


class Branching(nn.Module):
    """A module whose path depends on what it sees."""

    def __init__(self, space: Any, num_outputs: int) -> None:
        super().__init__()
        self.layer = nn.Linear(4, num_outputs)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([self.layer(row) if float(row.sum()) > 0 else self.layer(-row) for row in x.split(1)])


def test_a_module_that_branches_on_what_it_sees_is_refused_in_a_sentence(tmp_path):
    model = trained(lambda: TimeLimit(Corridor("a vector"), 10), policy=Branching)
    with pytest.raises(PgtsError, match=r"^the policy of .* cannot be traced by torch.export: .+$") as caught:
        model.export(tmp_path / "policy.pt2")
    assert len(str(caught.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())


class OwnPolicy(Policy):
    """Uniform, in code of the caller's own."""

    num_actions = 4

    def probs(self, observation_N: Tensor) -> Tensor:
        return torch.full((len(observation_N), 4), 0.25, dtype=torch.float64)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""


def test_what_no_file_can_hold_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    table = PGTS("FrozenLake-v1", depth=1, gamma=0.99)
    parts: dict[str, Any] = {"world": table.world, "source": table.source, "policy": OwnPolicy(), "notes": {}}
    with pytest.raises(PgtsError, match="the policy is a OwnPolicy, a class of your own, whose code no file holds"):
        exporting.export(tmp_path / "policy.pt2", None, **parts)
    with pytest.raises(PgtsError, match=r"ends in '\.zip'; a policy is exported as torch \(\.pt2\) or onnx \(\.onnx\)"):
        table.export(tmp_path / "policy.zip")
    with pytest.raises(PgtsError, match="format is 'jit'; a policy is exported as torch"):
        table.export(tmp_path / "policy.pt2", format="jit")  # type: ignore[arg-type]
    monkeypatch.setattr(exporting, "find_spec", lambda package: None if package == "onnxscript" else package)
    with pytest.raises(PgtsError, match=r"onnx needs onnxscript: pip install 'pgts_torch\[onnx\]'"):
        table.export(tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())


def test_an_earlier_export_is_replaced_and_no_other_file_is(tmp_path):
    table, path = PGTS("FrozenLake-v1", depth=1, gamma=0.99), tmp_path / "policy.pt2"
    table.export(path)
    first = path.read_bytes()
    table.learn(100).export(path)
    assert path.read_bytes() != first
    path.write_text("mine")
    with pytest.raises(PgtsError, match="exists and is not a policy that pgts_torch has exported"):
        table.export(path)
    assert path.read_text() == "mine"


# Without this package

ALONE = "import sys; sys.modules['pgts_torch'] = None; exec(open('act.py').read())"


@pytest.mark.parametrize("suffix", [".pt2", ".onnx"])
def test_the_script_of_the_page_acts_without_this_package_as_predict_does(suffix, tmp_path):
    if suffix == ".onnx":
        pytest.importorskip("onnxscript")
        pytest.importorskip("onnxruntime")
    text = PAGES["docs/start/after_training.md"].read_text(encoding="utf-8")
    [script] = [
        each.text for each in blocks(text) if f'("policy{suffix}")' in each.text and "import gymnasium" in each.text
    ]
    assert len([line for line in script.splitlines() if line.strip()]) <= 12
    model = PGTS("CartPole-v1", depth=1, num_envs=8).learn(1_000)
    model.export(tmp_path / f"policy{suffix}")
    (tmp_path / "act.py").write_text(script)
    command = [sys.executable, "-W", "ignore", "-c", ALONE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=True)
    env = gymnasium.make("CartPole-v1")
    observation, _ = env.reset(seed=0)
    total, over = 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(model.predict(observation))
        total, over = total + float(reward), terminated or truncated
    assert done.stdout == f"return {total:.0f}\n"
    blocked = subprocess.run(
        [*command[:-1], ALONE.replace("exec(open('act.py').read())", "import pgts_torch")],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert "ModuleNotFoundError" in blocked.stderr
