"""The ring of what was seen."""

import pytest
import torch

from pgts_torch.errors import PgtsError
from pgts_torch.models.replay import ReplayBuffer
from pgts_torch.seeding import stream


def filled(capacity, *sizes):
    """A buffer to which the numbers 0, 1, 2, ... were added, in calls of these sizes."""
    buffer, start = ReplayBuffer(capacity), 0
    for size in sizes:
        number_N = torch.arange(start, start + size)
        buffer.add(number=number_N, text=[str(n) for n in number_N.tolist()])
        start += size
    return buffer


@pytest.mark.parametrize("sizes", [(3,), (5,), (3, 4), (12,), (2, 12, 1), (0, 3, 0)])
def test_the_newest_rows_are_kept(sizes):
    buffer, total = filled(5, *sizes), sum(sizes)
    kept = list(range(max(0, total - 5), total))
    assert (len(buffer), buffer.num_added) == (len(kept), total)
    assert sorted(buffer.rows("number").tolist()) == kept
    assert [int(text) for text in buffer.rows("text")] == buffer.rows("number").tolist()


def test_all_rows_are_sampled_equally_often():
    buffer = filled(5, 3, 4)
    at_N = buffer.sample(50_000, generator=stream(0, "test"))
    counts = torch.bincount(buffer.rows("number", at_N), minlength=7)
    assert counts[:2].tolist() == [0, 0]
    # each count is binomial with deviation 89; outside of 5 deviations with a probability below 1e-5
    assert bool(((counts[2:] - 10_000).abs() < 450).all())
    assert buffer.rows("text", at_N[:3]) == [str(n) for n in buffer.rows("number", at_N[:3]).tolist()]


def test_a_loaded_buffer_goes_on_as_the_saved_one():
    one, other = filled(5, 3, 4), ReplayBuffer(5)
    other.load_state_dict(one.state_dict())
    for buffer in (one, other):
        buffer.add(number=torch.tensor([7]), text=["7"])
    assert one.rows("number").equal(other.rows("number"))
    assert (one.rows("text"), one.num_added) == (other.rows("text"), other.num_added)


def test_what_a_buffer_cannot_hold_is_refused():
    buffer = filled(5, 3)
    with pytest.raises(PgtsError, match="the same number"):
        buffer.add(number=torch.arange(2), text=["0"])
    with pytest.raises(PgtsError, match=r"\[.other.\]"):
        buffer.add(other=torch.arange(2))
    with pytest.raises(PgtsError, match="number has 4 rows; after 3 it has 3"):
        buffer.load_state_dict({"num_added": 3, "columns": {"number": torch.arange(4)}})
    with pytest.raises(PgtsError, match="capacity is 0"):
        ReplayBuffer(0)
