"""What a stranger gets who gives no options: the defaults on problems that they have not been chosen on.

    python benchmarks/defaults.py tables|networks [--seeds 1000 1001 ...] [--only NAME ...] [--short]

Prints the table of docs/benchmarks.md, section Defaults. `--short` (also `--quick`) takes less than a minute.
"""

import argparse

import defaults_networks
import defaults_tables
import torch

TABLES = {"tables": defaults_tables.table, "networks": defaults_networks.table}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("part", choices=list(TABLES))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1000, 1010)))
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="the rows whose first column begins so")
    parser.add_argument("--short", "--quick", action="store_true", help="less than a minute, for tests")
    given = parser.parse_args()
    torch.set_num_threads(1)
    TABLES[given.part](given.seeds[:1] if given.short else given.seeds, short=given.short, only=given.only)


if __name__ == "__main__":
    main()
