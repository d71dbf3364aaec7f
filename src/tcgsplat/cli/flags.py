"""Settings as flags of a command: apart from what makes a configuration of them, so that --help need not load that."""

from typing import Annotated

import tyro

Flags = Annotated[dict[str, str], tyro.conf.Fixed, tyro.conf.Suppress]
"""Texts of flags such as `--mapper.iterations 20` by dotted path; `main` puts them here, not the parser."""
