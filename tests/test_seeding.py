"""Named random streams."""

import itertools

import numpy as np
import pytest
import torch

from pgts_torch.seeding import numpy_stream, seed_sequence, stream

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
    drawn = np.concatenate([numbers(*key) for key in KEYS])
    assert len(np.unique(drawn)) == len(drawn)
    assert len(np.unique(np.concatenate([drawn, numbers(*KEYS[0])]))) == len(drawn)


def test_streams_of_neighbouring_seeds_are_uncorrelated():
    # |correlation| of 20,000 independent pairs exceeds 5 / sqrt(20,000) with probability 6e-7.
    x, y = numpy_stream(0, "rollout").random(20_000), numpy_stream(1, "rollout").random(20_000)
    assert abs(np.corrcoef(x, y)[0, 1]) < 5 / np.sqrt(20_000)
    assert abs(np.corrcoef(x, x + y)[0, 1]) > 5 / np.sqrt(20_000)


def test_drawing_from_one_stream_moves_no_other_and_no_global_generator():
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
