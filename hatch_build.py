"""The build hook of hatchling: `make wheel` names a folder of compiled libraries, which go into the wheel."""

from __future__ import annotations

import os
import re
import sysconfig
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Libraries(BuildHookInterface):
    """Takes the folder in ``$KORNIA_TIDY_LIBRARIES`` into a wheel of this platform; without one the wheel is pure."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the folder; not to an editable install, whose sources may change."""
        folder = os.environ.get("KORNIA_TIDY_LIBRARIES", "")
        if version == "editable" or not folder:
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{re.sub('[-.]', '_', sysconfig.get_platform())}"
        build_data["force_include"][folder] = "kornia_tidy/kernels/libraries"
