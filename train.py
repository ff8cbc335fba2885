"""`python train.py ...` is `pgts train ...`."""

import sys

from pgts_torch.cli.main import main

sys.exit(main(["train", *sys.argv[1:]]))
