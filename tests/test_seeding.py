"""Named random streams, and keys of single samples."""

import itertools

import numpy as np
import pytest
import torch
from scipy import stats

from pgts_torch.seeding import mix, numpy_stream, sample_keys, seed_sequence, stream, uniform

KEYS = [
    (seed, *names)
    for seed, names in itertools.product(
        (0, 1, 2, 3, 2**32, 2**63 - 1),
        [(), ("rollout",), ("search",), ("critic",), ("rollout", 0), ("rollout", 1), (0, "rollout")],
    )
]


def torch_numbers(seed: int, *names: str | int) -> np.ndarray:
    return torch.rand(500, dtype=torch.float64, generator=stream(seed, *names)).numpy()


def numpy_numbers(seed: int, *names: str | int) -> np.ndarray:
    return numpy_stream(seed, *names).random(500)


@pytest.mark.parametrize("numbers", [torch_numbers, numpy_numbers])
def test_the_same_seed_and_names_give_the_same_numbers(numbers):
    for key in KEYS:
        assert np.array_equal(numbers(*key), numbers(*key))


@pytest.mark.parametrize("numbers", [torch_numbers, numpy_numbers])
def test_other_names_and_neighbouring_seeds_share_no_number(numbers):
    # 21,000 numbers of 53 bits: two of them are equal by chance with probability 3e-8.
    found = np.concatenate([numbers(*key) for key in KEYS])
    assert len(np.unique(found)) == len(found)
    assert len(np.unique(np.concatenate([found, numbers(*KEYS[0])]))) == len(found)


def test_streams_of_neighbouring_seeds_are_uncorrelated():
    # |correlation| of 20,000 independent pairs exceeds 5 / sqrt(20,000) with probability 6e-7.
    x, y = numpy_stream(0, "rollout").random(20_000), numpy_stream(1, "rollout").random(20_000)
    assert abs(np.corrcoef(x, y)[0, 1]) < 5 / np.sqrt(20_000)
    assert abs(np.corrcoef(x, x + y)[0, 1]) > 5 / np.sqrt(20_000)


def test_numbers_of_one_stream_move_no_other_and_no_global_generator():
    kept, disturbed = stream(0, "rollout"), stream(0, "rollout")
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    torch.rand(100, generator=stream(0, "diagnostic"))
    numpy_stream(0, "diagnostic").random(100)
    assert torch.equal(torch.rand(9, generator=kept), torch.rand(9, generator=disturbed))
    assert torch.equal(torch.get_rng_state(), torch_state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002


@pytest.mark.parametrize("seed", [-1, -(2**40), 2**63])
def test_a_seed_out_of_range_is_refused_with_its_value(seed):
    with pytest.raises(ValueError, match=str(seed)):
        stream(seed, "rollout")


@pytest.mark.parametrize("name", [-1, 2**32])
def test_an_integer_name_out_of_range_is_refused(name):
    # 2**32 would be split in two words and so be the stream named (0, 1).
    with pytest.raises(ValueError, match=str(name)):
        seed_sequence(0, "rollout", name)


# Keys


def test_keys_are_mixed_as_the_published_generator_does_it():
    """The first three numbers of SplitMix64 with the seed 1234567."""
    numbers_N = mix(torch.tensor([1, 2, 3]), 1234567)
    assert [n % 2**64 for n in numbers_N.tolist()] == [6457827717110365317, 3203168211198807973, 9817491932198370423]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_neighbouring_keys_give_independent_uniform_numbers(dtype):
    """Each of six p-values is below 1e-4 with probability 1e-4: false alarms in 6 of 10,000 seeds."""
    key = sample_keys(1, generator=stream(0, "keys"))
    u_N = uniform(mix(key, torch.arange(20_000)), dtype).double().numpy()
    v_N = uniform(mix(key, torch.arange(20_000), 1), dtype).double().numpy()
    assert u_N.min() >= 0
    assert u_N.max() < 1
    assert stats.kstest(u_N, "uniform").pvalue > 1e-4
    assert stats.kstest(v_N, "uniform").pvalue > 1e-4
    assert stats.pearsonr(u_N, v_N).pvalue > 1e-4
    assert stats.pearsonr(u_N[1:], u_N[:-1]).pvalue > 1e-4


def test_the_order_of_names_counts_and_shapes_broadcast():
    key_N, a, b = sample_keys(5, generator=stream(0, "keys")), 3, 4
    assert not torch.equal(mix(key_N, a, b), mix(key_N, b, a))
    grid_NA = mix(key_N.unsqueeze(-1), torch.arange(3))
    assert grid_NA.shape == (5, 3)
    assert torch.equal(grid_NA[:, 2], mix(key_N, 2))
    assert grid_NA.unique().numel() == 15


def test_no_key_is_mixed_into_a_number_outside_the_half_open_interval():
    extreme_N = torch.tensor([0, -1, 1, 2**63 - 1, -(2**63)])
    for dtype in (torch.float32, torch.float64):
        u_N = uniform(extreme_N, dtype)
        assert bool(((u_N >= 0) & (u_N < 1)).all())
