"""The build backend: setuptools, with one time stamp for all files, so that the same sources give the same bytes."""

from __future__ import annotations

import os

os.environ.setdefault("SOURCE_DATE_EPOCH", "315532800")  # 1980, the first year that a ZIP archive can express

from setuptools.build_meta import *  # noqa: F403
