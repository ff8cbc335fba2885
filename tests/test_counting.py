"""The counter of operations and reads counts what it says."""

import pytest
import torch

from tests.counting import Counting

READS = {
    "item": lambda x: x.sum().item(),
    "float": lambda x: float(x.sum()),
    "int": lambda x: int(x.sum()),
    "bool": lambda x: bool(x.any()),
    "if": lambda x: 1 if x.sum() > 0 else 0,
    "tolist": lambda x: x.tolist(),
    "cpu": lambda x: x.cpu(),
    "numpy": lambda x: x.numpy(),
    "nonzero": lambda x: torch.nonzero(x),
    "mask": lambda x: x[x > 1],
    "equal": lambda x: torch.equal(x, x + 1),
    "unique": lambda x: torch.unique(x),
    "repeats": lambda x: torch.arange(3).repeat_interleave(x.long()),
}


@pytest.mark.parametrize("read", READS.values(), ids=READS)
def test_a_read_is_counted_once(read):
    with Counting() as counts:
        read(torch.arange(3.0))
    assert counts.num_reads == 1, counts.reads


def test_operations_are_counted_and_views_are_not():
    x = torch.arange(12.0)
    with Counting() as counts:
        x.view(3, 4).t()[1:].unsqueeze(0).expand(2, 3, 3).split(1, 1)
        (x * 2).add_(1)
        torch.where(x > 0, x, 0.0)[torch.tensor([1, 2])]
    assert counts.reads == {}
    assert counts.operations == {"mul": 1, "add_": 1, "gt": 1, "where": 1, "scalar_tensor": 1, "index": 1}
