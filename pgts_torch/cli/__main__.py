"""`python -m pgts_torch.cli` is `pgts`."""

import sys

from pgts_torch.cli.main import main

sys.exit(main())
