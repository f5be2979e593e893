"""``python -m imudrv``."""

import sys

from imudrv.cli import main

sys.exit(main())
