"""The command line's own work: finding the command, reading flags, counting, warning, measuring, refusing."""

import json
import logging
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from numba import njit

from tcgsplat import __version__
from tcgsplat.cli import doctor, kernels, logs, presets, summary
from tcgsplat.cli.interrupt import stopping_on_interrupt
from tcgsplat.cli.main import COMMANDS, main
from tcgsplat.cli.progress import RunProgress, counting
from tcgsplat.cli.recorder import Part, begin
from tcgsplat.cli.settings import resolved
from tcgsplat.cli.usage import UsageError
from tcgsplat.config import SlamConfig, from_toml
from tcgsplat.errors import ArchiveError, ConfigError
from tcgsplat.geometry import se3
from tcgsplat.loop.closer import Closure
from tcgsplat.loop.edge import odometry
from tcgsplat.presets import preset
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.slam import StepReport
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tracking.tracker import Tracked

ENOUGH = 1.5  # seconds in which --help must be there, on a busy machine


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("NUMBA_THREADING_LAYER", "OMP_WAIT_POLICY")}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=kept | environment)


# The front door.


@pytest.mark.parametrize("argument", ["--help", "--version"])
def test_help_and_version_are_there_at_once(argument: str):
    started = time.perf_counter()
    done = python(
        "import sys; from tcgsplat.cli.main import main\n"
        f"code = main([{argument!r}])\n"
        "heavy = {'torch', 'numba', 'numpy', 'cv2', 'scipy', 'tyro', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else code)"
    )
    assert done.returncode == 0, done.stderr
    assert time.perf_counter() - started < ENOUGH
    assert done.stdout.startswith("usage: tcgsplat" if argument == "--help" else f"tcgsplat {__version__}\n")


def test_a_run_begins_without_what_only_closing_a_loop_needs():
    done = python("import sys, tcgsplat.cli.recorder; sys.exit('gtsam' in sys.modules)")
    assert done.returncode == 0, done.stderr


def test_help_lists_every_command_and_every_command_is_there(capsys: pytest.CaptureFixture[str]):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for command, summary_line in COMMANDS.items():
        assert f"{command} " in text and summary_line in text
        assert main([command, "--help"]) == 0
        assert f"usage: tcgsplat {command}" in capsys.readouterr().out


@pytest.mark.parametrize(("given", "expected"), [({}, "omp passive"), ({"OMP_WAIT_POLICY": "active"}, "omp active")])
def test_threads_are_told_to_sleep_before_anything_is_imported(given: dict[str, str], expected: str):
    code = (
        "import os; from tcgsplat.cli.main import main; main(['--version'])\n"
        "print(os.environ['NUMBA_THREADING_LAYER'], os.environ['OMP_WAIT_POLICY'])"
    )
    assert python(code, **given).stdout.splitlines()[1] == expected


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        ([], 2, "usage: tcgsplat COMMAND"),
        (["rnu"], 2, "tcgsplat: there is no command rnu; did you mean run?\n"),
        (["zebra"], 2, "tcgsplat: there is no command zebra; `tcgsplat --help` lists them\n"),
        (["run"], 2, "FOLDER"),
        (["run", "here", "--strid", "3"], 2, "--strid"),
        (["run", "here", "--stride", "three"], 2, "three"),
        (["run", "here", "--mapper.iteration", "3"], 2, "there is no setting mapper.iteration; did you mean mapper.it"),
        (["run", "here", "--mapper.iterations", "x"], 2, '--mapper.iterations is "x"; it must be a whole number'),
        (["run", "here", "--mapper.iterations"], 2, '--mapper.iterations is ""; it must be a whole number'),
        (["run", "here", "--preset", "papier"], 2, "--preset: there is no preset papier; "),
        (["run", "nowhere"], 1, "tcgsplat: no folder nowhere; check the path\n"),
        (["run", "nowhere", "--config", "no.toml"], 1, "tcgsplat: cannot take settings from no.toml: "),
        (["eval"], 2, "tcgsplat: give a run directory, or --trajectory and --sequence\n"),
        (["eval", "nowhere"], 1, "tcgsplat: there is no folder nowhere; give the one that `tcgsplat run` wrote"),
        (["eval", "--trajectory", "t.txt"], 2, "tcgsplat: --trajectory needs something to compare with; "),
        (["eval", "nowhere", "--withheld-every", "0"], 2, "tcgsplat: --stride and --withheld-every count from 1\n"),
        (["export", "nowhere"], 1, "tcgsplat: there is no folder nowhere; "),
        (["bench", "confidence"], 2, "tcgsplat: give the folders of the sequences, such as"),
        (["bench", "ablation"], 2, "tcgsplat: give the folders of the sequences, such as"),
        (["bench", "nothing"], 2, "render, track"),
        (["bench", "track"], 2, "FOLDER"),
        (["bench", "render", "--repeats", "0"], 2, "tcgsplat: --repeats must be at least 1, and --threads from 1 to "),
        (["run", "nowhere", "--seed", "-1"], 2, "tcgsplat: seed is -1; it must be from 0 to 9223372036854775807\n"),
        (["bench", "track", "nowhere"], 1, "tcgsplat: no folder nowhere; check the path\n"),
        (["bench", "track", "nowhere", "--mapper.iteration", "3"], 2, "there is no setting mapper.iteration; did you"),
        (["bench", "render", "--mapper.iterations", "3"], 2, "this bench has no settings, but --mapper.iterations"),
        (["presets", "default", "--mapper.iterations", "3"], 2, "--mapper.iterations"),
        (["presets", "papier"], 1, "tcgsplat: there is no preset papier; "),
    ],
)
def test_what_is_wrong_is_said_on_standard_error(
    arguments: list[str], code: int, sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert sentence in said.err
    assert "Traceback" not in said.err
    if said.err.startswith("tcgsplat: "):
        assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_where_it_went_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["export", str(tmp_path), "--debug"]) == 1
    said = capsys.readouterr().err
    assert "Traceback" in said and said.endswith("json')\n") and f"tcgsplat: {tmp_path} is not a run" in said


# Settings.


def test_a_flag_counts_more_than_the_file_and_the_file_more_than_the_preset(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text("seed = 5\n[mapper]\niterations = 7\nfirst_iterations = 8\n")
    flags = {"mapper.iterations": "9", "tracker.solver": "alignment", "confidence.decay_time": "inf"}
    config = resolved("paper-tum", file, flags, None)
    assert (config.mapper.iterations, config.mapper.first_iterations, config.seed) == (9, 8, 5)
    assert (config.tracker.solver, config.confidence.decay_time) == ("alignment", math.inf)
    assert config.mapper.seeding == preset("paper-tum").mapper.seeding
    assert resolved("paper-tum", file, flags, 6).seed == 6
    assert resolved("default", None, {}, None) == SlamConfig()


def test_who_gave_a_wrong_setting_is_told_where(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text("[mapper]\niteration = 7\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: there is no setting mapper\.iteration; did you mean"):
        resolved("default", file, {}, None)
    with pytest.raises(UsageError, match=r"--mapper\.sh_degree is 1\.5; it must be a whole number"):
        resolved("default", None, {"mapper.sh_degree": "1.5"}, None)
    with pytest.raises(UsageError, match="sh_degree is 9; it must be 0, 1, 2 or 3"):
        resolved("default", None, {"mapper.sh_degree": "9"}, None)


def test_flags_may_be_written_in_all_usual_ways(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    # The folder does not exist: whoever gets as far as looking for it has understood the settings.
    for flags in (
        ["--mapper.first-iterations=3", "nowhere"],
        ["--mapper.first_iterations", "3", "nowhere", "--tracker.alignment.iterations", "[1, 2]"],
        ["nowhere", "--confidence.guide-mapping", "false", "--tracker.solver", "descent", "--seed", "3"],
    ):
        assert main(["run", *flags]) == 1
        assert "no folder nowhere" in capsys.readouterr().err


# What a run tells while it goes.


def report(index: int, lost: str = "", *, seconds: float = 0.01) -> StepReport:
    tracked = Tracked(se3.identity(), lost)
    return StepReport(
        index, tracked, False, None, None, None, None, 0, 1000 + index, {"track": seconds, "map": 2 * seconds}
    )


def test_losing_the_way_is_told_once_not_for_every_frame(capsys: pytest.CaptureFixture[str]):
    with logs.on_stderr(debug=False), RunProgress(9) as progress:
        for index, lost in enumerate(["", "", "too dark", "too dark", "too dark", "", "", "too far", ""]):
            progress.observe(report(index, lost))
    assert capsys.readouterr().err.splitlines() == [
        "tcgsplat: warning: tracking is lost at frame 2: too dark",
        "tcgsplat: warning: tracking is found again at frame 5",
        "tcgsplat: warning: tracking is lost at frame 7: too far",
        "tcgsplat: warning: tracking is found again at frame 8",
    ]


def test_progress_is_quiet_in_a_pipe(capsys: pytest.CaptureFixture[str]):
    with RunProgress(3) as progress, counting("frame") as count:
        for index in range(3):
            progress.observe(report(index))
            count(index, 3)
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", "")


def test_many_warnings_of_a_kind_become_a_number(capsys: pytest.CaptureFixture[str]):
    logger = logging.getLogger("tcgsplat.datasets.recording")
    with logs.on_stderr(debug=False):
        for index in range(40):
            logger.warning("frame %d is skipped: %s", index, "broken")
        logger.warning("something else")
        logger.info("not for everybody")
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == [f"tcgsplat: warning: frame {i} is skipped: broken" for i in range(2)]
    assert lines[logs.SHOWN :] == [
        "tcgsplat: warning: something else",
        f"tcgsplat: warning: {40 - logs.SHOWN} more like this, the last: frame 39 is skipped: broken",
    ]
    logger.warning("after the command")
    with logs.on_stderr(debug=True):
        logger.info("for those who ask")
    assert capsys.readouterr().err == "tcgsplat: for those who ask\n"


def test_the_first_frame_does_not_count_in_times():
    tally = summary.Tally()
    for index, (seconds, whole) in enumerate([(5.0, 20.0), (0.010, 0.04), (0.010, 0.04), (0.040, 0.13)]):
        tally.count(report(index, "dark" if index == 2 else "", seconds=seconds), whole)
    rows = tuple(TrackedPose(i, i / 30, 0, se3.identity(), lost=i == 2) for i in range(4))
    edge = odometry(1, 0, se3.identity())
    closures = [Closure(0), Closure(1, edges=(edge, *[replace(edge, loop=True)] * 3), rejected=(edge,), seconds=0.5)]
    result = tally.summary(Trajectory(rows), closures, submaps=2, gaussians=30, seconds=21.0, interrupted=False)
    assert (result.loops, result.loops_rejected, result.ms_closure) == (2, 1, 250.0)
    assert result.seconds_lost == pytest.approx(1 / 30)
    assert (result.frames, result.frames_lost, result.submaps, result.gaussians) == (4, 1, 2, 30)
    assert result.ms_per_frame == pytest.approx(70.0)
    assert result.ms_per_frame_median == pytest.approx(40.0)
    assert result.stage_ms == pytest.approx({"track": 20.0, "map": 40.0})
    assert str(result) == (
        "4 frames in 21.0 s (70 ms a frame, beginning and end aside), 1 lost, 2 submaps, 2 loops closed, 30 Gaussians"
    )
    versions = json.loads(json.dumps(result.to_dict()))["versions"]
    assert versions["torch"] == torch.__version__
    assert versions["source"] == subprocess.run(
        [sys.executable, "-c", "from tcgsplat.cli.summary import source; print(source())"],
        capture_output=True, check=True, text=True,
    ).stdout.strip(), "another process finds another source"  # fmt: skip
    assert 50 < (result.peak_rss_mb or 0) < 100_000
    assert "core" in result.machine


def test_a_run_of_no_frames_still_has_a_summary():
    result = summary.Tally().summary(Trajectory(), (), submaps=0, gaussians=0, seconds=0.1, interrupted=True)
    assert (result.frames, result.ms_per_frame, result.interrupted) == (0, 0.0, True)


def test_compiling_is_announced_once_and_only_if_there_is_any():
    announced: list[str] = []

    @njit
    def once(x: int) -> int:
        return x + 1

    @njit
    def twice(x: int) -> int:
        return once(once(x))

    with kernels._heard_compiling(lambda: announced.append("compiling")):
        assert twice(1) == 3
    assert announced == ["compiling"]
    with kernels._heard_compiling(lambda: announced.append("compiling")):
        assert twice(2) == 4
    twice(3.0)
    assert announced == ["compiling"]


def test_the_first_ctrl_c_asks_and_the_second_insists(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(KeyboardInterrupt), stopping_on_interrupt() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler
    assert capsys.readouterr().err == "tcgsplat: stopping after this frame; Ctrl-C again to stop at once\n"


# The run directory.


def test_a_run_directory_knows_what_was_asked_for(tmp_path: Path):
    config = resolved("base", None, {"mapper.iterations": "3"}, 4)
    run = begin(tmp_path / "a" / "run", config, tmp_path / "data", Part(1, 2, 3), overwrite=False)
    assert Part.of(run) == Part(1, 2, 3)
    assert from_toml(run.config_toml) == config
    assert run.sequence == str(tmp_path / "data")
    (run.path / "request.json").unlink()
    assert Part.of(run) == Part()
    (run.path / "request.json").write_text("{}")
    with pytest.raises(ArchiveError, match=r"cannot read .*request\.json"):
        Part.of(run)


def test_only_a_run_is_ever_overwritten(tmp_path: Path):
    config, data = SlamConfig(), tmp_path / "data"
    run = begin(tmp_path / "run", config, data, Part(), overwrite=False)
    (run.path / "submaps" / "0000.npz").write_bytes(b"old")
    choose = "choose another folder by --out, or replace the run by --overwrite"
    with pytest.raises(ArchiveError, match=f"exists; go on with the unfinished run in it by --resume, {choose}"):
        begin(run.path, config, data, Part(), overwrite=False)
    run.write_summary({"interrupted": False})
    with pytest.raises(ArchiveError, match=f"exists; {choose}"):
        begin(run.path, config, data, Part(), overwrite=False)
    assert (run.path / "submaps" / "0000.npz").exists()
    assert begin(run.path, config, data, Part(), overwrite=True).submap_count == 0

    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "holiday.jpg").write_bytes(b"dear")
    (tmp_path / "file").write_bytes(b"dear")
    for path in (photos, tmp_path / "file"):
        with pytest.raises(ArchiveError, match="is not a run"):
            begin(path, config, data, Part(), overwrite=True)
    assert (photos / "holiday.jpg").read_bytes() == b"dear"
    (tmp_path / "empty").mkdir()
    assert isinstance(begin(tmp_path / "empty", config, data, Part(), overwrite=False), RunDirectory)


# Commands that only look.


def test_presets_are_listed_and_explained(capsys: pytest.CaptureFixture[str]):
    assert presets.command(presets.Args()) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[:2]] == ["default", "base"]
    assert presets.command(presets.Args("paper-scannet")) == 0
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line}
    assert rows["tracker.descent.min_alpha"][:2] == ["0.98", "base"]
    assert rows["confidence.tracking_floor"][:2] == ["0.2", "paper"]
    assert rows["confidence.p_min"][:2] == ["0.1", "ours"]


def test_doctor_tells_what_can_be_used(capsys: pytest.CaptureFixture[str]):
    assert doctor.command(doctor.Args()) == 0
    text = capsys.readouterr().out
    assert f"torch {torch.__version__}" in text
    assert "numba: usable\n" in text and "AVX-512" in text
    if torch.cuda.is_available():
        assert "cuda: usable\n  the default, on the GPU" in text
    else:
        assert "cuda: not usable\n" in text and "gsplat: not usable\n  what `cuda` needs comes first" in text
        assert torch.version.cuda is not None or "is built without CUDA: `pip install " in text
    assert "compiled kernels are kept in" in doctor.numba_finding().facts[2]
