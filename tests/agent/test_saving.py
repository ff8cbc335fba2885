"""A saved model goes on as if nothing had happened; a damaged or foreign file is refused and runs nothing."""

import functools
import pickle
from fractions import Fraction
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from pgts_torch import PGTS
from pgts_torch.agent import saving
from pgts_torch.agent.policies import SoftmaxPolicy
from pgts_torch.agent.updates import SoftmaxUpdate
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource
from pgts_torch.options import MCTS, FixedHorizon, Mirror, Softmax, SoftmaxGradient, TabularValues
from tests.agent.helpers import same_bits

KINDS = {
    "tabular v": {"critic": "tabular", "update": {"type": "mirror", "step_size": 0.3}},
    "tabular q": {"critic": {"type": "tabular", "target": "q", "step_size": "mean"}, "horizon": "geometric"},
    "rollout": {"critic": {"type": "rollout", "samples": 2}, "horizon": {"type": "fixed", "length": 5}},
    "exact": {"critic": "exact", "policy": {"type": "simplex", "init": "random"}},
}


def make(env: str = "pgts/Ladder-v0", **kwargs) -> PGTS:
    return PGTS(env, **{"depth": 2, "num_envs": 4, "horizon": {"type": "fixed", "length": 12}, "seed": 7} | kwargs)


def assert_same_tensors(first: dict, second: dict) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.parametrize("env", ["pgts/Ladder-v0", "FrozenLake-v1"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_model_trains_on_bit_for_bit_like_the_uninterrupted_one(kind, env, tmp_path):
    path = tmp_path / "model.pt"
    whole = make(env, **KINDS[kind])
    for _ in range(3):
        whole.iterate()
    whole.save(path)
    loaded = PGTS.load(path)
    assert loaded.state_dict().keys() == whole.state_dict().keys()
    for _ in range(3):
        first, second = whole.iterate(), loaded.iterate()
        assert same_bits(first.experience, second.experience)
        for name in ("state_N", "weight_N", "pi_NA", "gap_N"):
            assert torch.equal(getattr(first, name), getattr(second, name))
        assert torch.equal(first.look.q_BA, second.look.q_BA)
        assert first.losses == second.losses
    for part in ("policy", "critic"):
        assert_same_tensors(whole.state_dict()[part], loaded.state_dict()[part])
    assert loaded.num_env_steps == whole.num_env_steps
    assert loaded.num_iterations == 6
    assert loaded.num_model_calls == whole.num_model_calls
    other = make(env, **KINDS[kind] | {"seed": 8})
    assert not same_bits(other.iterate().experience, make(env, **KINDS[kind]).iterate().experience)


def test_a_model_is_loaded_with_everything_that_it_was_made_with(tmp_path):
    path = tmp_path / "model.pt"
    made = PGTS(
        "pgts/Grid-v0",
        depth=3,
        policy={"type": "softmax", "init": {"type": "biased", "action": 1, "probability": 0.6}},
        update={"type": "softmax", "step_size": 0.2, "state_weight": "visits"},
        num_envs=3,
        gamma=0.8,
        search={"type": "expectimax", "max_nodes": 5000},
        env_kwargs={"size": 4, "traps": (5,)},
    )
    made.save(path)
    loaded = PGTS.load(path, device="cpu")
    assert torch.equal(loaded.policy.table(), made.policy.table())
    assert loaded.depth_choice.depths == made.depth_choice.depths
    for name in ("seed", "gamma", "options", "horizon", "device"):
        assert getattr(loaded, name) == getattr(made, name)
    assert loaded.search.options.max_nodes == 5000
    assert loaded.world.env.num_envs == 3
    assert torch.equal(loaded.mdp.outcomes.reward_NA, made.mdp.outcomes.reward_NA)
    loaded.save(path)
    assert PGTS.load(path).iterate().experience.num_steps == made.iterate().experience.num_steps


def test_a_model_is_loaded_with_the_options_that_it_was_made_with(tmp_path):
    path = tmp_path / "model.pt"
    options = {"policy": Softmax(), "critic": TabularValues(target="q"), "update": Mirror(floor="never")}
    made = make(**options, search=MCTS(simulations=3), horizon=FixedHorizon(length=4))
    made.save(path)
    assert PGTS.load(path).options == made.options
    assert made.options.update.floor == "never"
    assert PGTS.load(path).search.options.simulations == 3


def test_a_seed_and_a_discount_from_numpy_are_saved(tmp_path):
    path = tmp_path / "model.pt"
    PGTS("FrozenLake-v1", depth=1, seed=np.arange(4)[3], gamma=np.linspace(0, 1, 5)[3]).save(path)
    model = PGTS.load(path)
    assert (model.seed, model.gamma) == (3, 0.75)


def test_a_model_saved_over_itself_leaves_one_file(tmp_path):
    path, model = tmp_path / "model.pt", make()
    model.save(path)
    first = path.read_bytes()
    model.learn(100)
    model.save(path)
    assert path.read_bytes() != first
    assert [file.name for file in tmp_path.iterdir()] == ["model.pt"]
    assert PGTS.load(path).num_env_steps == model.num_env_steps


@pytest.mark.fault("flipped bits and missing ends of a saved model")
def test_every_flipped_bit_and_every_missing_end_is_noticed(tmp_path):
    path = tmp_path / "model.pt"
    make().save(path)
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    places = [*range(64), *random.integers(64, len(whole), size=300).tolist()]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(random.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(PgtsError, match=r"model.pt is (damaged|not a file saved by pgts_torch)"):
            PGTS.load(path)
    for length in [0, 1, 12, 13, 44, 45, 46, *random.integers(46, len(whole), size=50).tolist()]:
        path.write_bytes(whole[:length])
        with pytest.raises(PgtsError, match=r"model.pt is (damaged|not a file saved by pgts_torch)"):
            PGTS.load(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(PgtsError, match="damaged"):
        PGTS.load(path)
    path.write_bytes(whole)
    PGTS.load(path)


class Bomb:
    """Unpickling it writes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def sealed(payload: bytes) -> bytes:
    """A file whose checksum is right, whatever it holds."""
    return saving.sealed(payload)


@pytest.mark.fault("pickled payload in a saved model")
def test_a_pickled_payload_is_refused_and_not_executed(tmp_path):
    trace, path = tmp_path / "trace", tmp_path / "model.pt"
    torch.save({"arguments": Bomb(trace), "state": {}}, tmp_path / "bomb.pt")
    for payload in (pickle.dumps(Bomb(trace)), (tmp_path / "bomb.pt").read_bytes()):
        for content in (payload, sealed(payload)):
            path.write_bytes(content)
            with pytest.raises(PgtsError, match=r"model.pt (is not a file saved|holds something other)"):
                PGTS.load(path)
    assert not trace.exists()
    pickle.loads(pickle.dumps(Bomb(trace))).close()
    assert trace.exists()


@pytest.mark.fault("foreign content in a saved model")
@pytest.mark.filterwarnings("ignore:Detected pickle protocol:UserWarning")
@pytest.mark.parametrize("payload", [b"", b"\x80", b"PK\x03\x04", b"hello", bytes(range(256)), b"\x80\x02]q\x00."])
def test_a_whole_file_with_foreign_content_is_refused(payload, tmp_path):
    path = tmp_path / "model.pt"
    path.write_bytes(sealed(payload))
    with pytest.raises(PgtsError, match=r"model.pt holds"):
        PGTS.load(path)


def test_a_model_that_version_0_1_has_saved_is_refused_by_its_version():
    # `PGTS("pgts/Ladder-v0", depth=4, seed=3, num_envs=4)` of that version, after two iterations.
    with pytest.raises(PgtsError, match=r"was saved by version 0\.1, which this version does not read") as raised:
        PGTS.load(Path(__file__).parents[1] / "golden/saved_by_0_1.pt")
    assert not isinstance(raised.value, saving.Damaged)


def test_other_files_and_no_file_are_refused_by_name(tmp_path):
    path = tmp_path / "model.pt"
    with pytest.raises(PgtsError, match=r"model.pt cannot be read: No such file"):
        PGTS.load(path)
    with pytest.raises(PgtsError, match="cannot be read"):
        PGTS.load(tmp_path)
    torch.save({"arguments": {}, "state": {}}, path)
    with pytest.raises(PgtsError, match=r"model.pt is not a file saved by pgts_torch"):
        PGTS.load(path)
    saving.write(path, {"weights": torch.zeros(3)})
    with pytest.raises(PgtsError, match=r"model.pt holds \['weights'\], not a model"):
        PGTS.load(path)


@pytest.mark.parametrize(
    "env",
    [
        lambda: EnvSource.of("pgts/Ladder-v0").make(4),
        lambda: gymnasium.make("FrozenLake-v1"),
        lambda: functools.partial(gymnasium.make, "FrozenLake-v1", is_slippery=False),
    ],
    ids=["vector env", "instance", "function"],
)
def test_a_model_of_an_environment_that_is_an_object_is_loaded_with_one(env, tmp_path):
    path = tmp_path / "model.pt"
    short = {"depth": 1, "num_envs": 4, "horizon": {"type": "fixed", "length": 12}, "seed": 7}
    whole = PGTS(env(), **short)
    whole.iterate()
    whole.save(path)
    with pytest.raises(PgtsError, match=r"model.pt names no environment, for it was given as an object: load it with"):
        PGTS.load(path)
    loaded = PGTS.load(path, env=env())
    assert same_bits(whole.iterate().experience, loaded.iterate().experience)
    assert_same_tensors(whole.state_dict()["policy"], loaded.state_dict()["policy"])
    make().save(path)
    with pytest.raises(PgtsError, match=r"model.pt has its own, pgts/Ladder-v0"):
        PGTS.load(path, env=env())


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("policy", lambda: SoftmaxPolicy(5, 2)),
        ("update", lambda: SoftmaxUpdate(SoftmaxGradient(step_size=0.3))),
    ],
)
def test_a_model_with_a_part_that_no_file_can_describe_is_not_saved(name, part, tmp_path):
    model = make(**{name: part()})
    model.iterate()
    with pytest.raises(PgtsError, match=f"{name} was given as"):
        model.save(tmp_path / "model.pt")
    assert not list(tmp_path.iterdir())


def test_a_model_that_cannot_be_saved_leaves_the_file_as_it_was(tmp_path):
    path = tmp_path / "model.pt"
    make().save(path)
    whole = path.read_bytes()
    with pytest.raises(PgtsError, match="something other than tensors and plain values"):
        make(reward_range=(Fraction(-5), Fraction(5))).save(path)
    assert path.read_bytes() == whole
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("write", ["save", "record", "export"])
def test_what_is_no_path_is_refused_by_all_that_write_a_file(write):
    model = make()
    with pytest.raises(PgtsError, match=r"^3 is no path; it must be a str or a pathlib.Path$"):
        getattr(model, write)(3)
