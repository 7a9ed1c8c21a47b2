"""Lets `python -m sphstereo_ros.cli` do what `sphstereo` does."""
from __future__ import annotations

import sys

from sphstereo_ros.cli import main

if __name__ == '__main__':
    sys.exit(main())
