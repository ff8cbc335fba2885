"""What the caller is told."""

import linecache

import pytest
import torch

from pgts_torch.errors import warn


def test_a_warning_names_the_line_from_which_the_package_was_called():
    package = {"__name__": "pgts_torch.somewhere", "warn": warn, "torch": torch}
    exec("def inner(): warn('it is so')\n@torch.no_grad()\ndef outer(): inner()", package)
    with pytest.warns(UserWarning, match="it is so") as said:
        package["outer"]()
    assert linecache.getline(said[0].filename, said[0].lineno).strip() == 'package["outer"]()'
