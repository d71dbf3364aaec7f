"""The settings of a run from what was asked for: a preset, over it a file, over it flags."""

import tomllib
from collections.abc import Mapping
from pathlib import Path

from tcgsplat.cli.flags import Flags as Flags
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig, from_toml, with_settings
from tcgsplat.errors import ConfigError
from tcgsplat.presets import preset


def resolved(name: str, file: Path | None, flags: Mapping[str, str], seed: int | None) -> SlamConfig:
    """Settings of a preset, changed by a TOML file, changed by flags.

    Raises:
        ConfigError: if the file cannot be read, or holds what is not a setting or cannot be right.
        UsageError: the same of the preset's name and the flags.
    """
    try:
        config = preset(name)
    except ConfigError as error:
        raise UsageError(f"--preset: {error}") from error
    if file is not None:
        try:
            config = from_toml(file.read_text(encoding="utf-8"), config)
        except (OSError, ValueError, ConfigError) as error:
            raise ConfigError(f"cannot take settings from {file}: {error}") from error
    values = {path: _value(text) for path, text in flags.items()} | ({} if seed is None else {"seed": seed})
    try:
        return with_settings(config, values)
    except ConfigError as error:
        raise UsageError(f"--{error}" if str(error).split()[0] in flags else str(error)) from error


def _value(text: str) -> object:
    """What TOML makes of the text, or else the text: quotes round a word may be left out."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
