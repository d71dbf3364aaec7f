"""`tcgsplat`: a table of commands. A command's module, and with it torch and numba, is imported when it is called."""

import difflib
import gc
import os
import sys
import traceback
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from types import MappingProxyType
from typing import Any

from tcgsplat import __version__
from tcgsplat.cli import logs
from tcgsplat.cli.usage import UsageError
from tcgsplat.errors import TCGSplatError

COMMANDS: Mapping[str, str] = MappingProxyType(
    {
        "run": "map a recorded RGB-D folder: Gaussian map, trajectory and confidence",
        "demo": "make a synthetic apartment, map it, and show how well that went",
        "refine": "optimise the map of a finished run further, for better pictures",
        "eval": "score a run: report.json, contact sheet, trajectory plot",
        "localize": "find where in a finished map pictures were taken",
        "export": "write a run's map as one PLY file and its trajectory as text",
        "synth": "write the synthetic apartment as an RGB-D folder",
        "bench": "measure how long the stages take on this machine, and what confidence is worth",
        "presets": "list the presets, or every value of one with its origin",
        "doctor": "say which backend this machine can use, and why not another",
    }
)
ENVIRONMENT: Mapping[str, str] = MappingProxyType(
    {
        "NUMBA_THREADING_LAYER": "omp",
        "OMP_WAIT_POLICY": "passive",
        "OPENBLAS_NUM_THREADS": "1",
        "OPENCV_FOR_THREADS_NUM": "1",
    }
)
"""Read by numba, torch's OpenMP, numpy's OpenBLAS and OpenCV when they are imported: without it their waiting threads
keep cores busy, and who tracks waits for a helper that may be behind all others. Their arrays are small here."""

YOUNG = 10_000
"""Objects that are made before Python looks for cycles among them. Imports make half a million that all stay: by
Python's own 700, looking through them takes a third of the time to start."""

DONE, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
"""Exit codes."""


def main(argv: list[str] | None = None) -> int:
    """Run one command; gives its exit code: 0 done, 1 an error that is ours to explain, 2 usage, 130 interrupted."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    gc.set_threshold(YOUNG)
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    arguments = [argument for argument in arguments if argument != "--debug"]
    match arguments:
        case ["-h" | "--help" | "help", *_]:
            sys.stdout.write(_help())
            return DONE
        case ["--version", *_]:
            sys.stdout.write(f"tcgsplat {__version__}\n")
            return DONE
        case [command, *rest] if command in COMMANDS:
            return _run(command, rest, debug)
        case [unknown, *_]:
            near = difflib.get_close_matches(unknown, COMMANDS, n=1)
            advice = f"did you mean {near[0]}?" if near else "`tcgsplat --help` lists them"
            return _complain(f"there is no command {unknown}; {advice}", USAGE)
    sys.stderr.write(_help())
    return USAGE


def _run(command: str, arguments: list[str], debug: bool) -> int:
    try:
        with logs.on_stderr(debug):
            module = import_module(f"tcgsplat.cli.{command}")
            code: int = module.command(_parsed(command, module.Args, arguments))
            sys.stdout.flush()  # here, so that a closed pipe is met here
            return code
    except SystemExit as stop:  # tyro has said what is wrong with the arguments, or has printed the help
        return stop.code if isinstance(stop.code, int) else USAGE
    except BrokenPipeError:  # whoever read our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (TCGSplatError, OSError) as error:
        if debug:
            traceback.print_exc()
        return _complain(logs.sentence(error), USAGE if isinstance(error, UsageError) else FAILED)
    except KeyboardInterrupt as interrupt:
        return _complain(str(interrupt) or "interrupted", INTERRUPTED)


def _parsed(command: str, kind: Any, arguments: list[str]) -> Any:
    """The command's arguments; flags with a dot, such as `--mapper.iterations 20`, are settings."""
    from tcgsplat.cli.parsing import parsed

    own, flags = _split(arguments)
    if flags and "settings" not in kind.__dataclass_fields__:
        own += [f"--{path}" for path in flags]  # unknown to this command, and it will say so
    args = parsed(kind, f"tcgsplat {command}", own)
    return replace(args, settings=flags) if flags else args


def _split(arguments: list[str]) -> tuple[list[str], dict[str, str]]:
    """Arguments of the command, and the text of each setting by its dotted path."""
    own: list[str] = []
    flags: dict[str, str] = {}
    rest = iter(arguments)
    for argument in rest:
        name, assigned, value = argument.removeprefix("--").partition("=")
        if argument.startswith("--") and "." in name:
            flags[name.replace("-", "_")] = value if assigned else next(rest, "")
        else:
            own.append(argument)
    return own, flags


def _complain(sentence: str, code: int) -> int:
    sys.stderr.write(f"tcgsplat: {sentence}\n")
    return code


def _help() -> str:
    width = max(map(len, COMMANDS))
    commands = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return f"""usage: tcgsplat COMMAND ...

RGB-D SLAM over local 3D Gaussian submaps, with a temporal confidence for every Gaussian.

{commands}

`tcgsplat COMMAND --help` tells the rest. Everywhere: --debug shows tracebacks and more of the log.
`tcgsplat --version` gives the version. Exit codes: 0 done, 1 error, 2 usage, 130 interrupted.
"""


if __name__ == "__main__":
    sys.exit(main())
