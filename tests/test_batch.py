"""Many logs at once: what is done, what is recorded, and what survives an interrupt."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Generator, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner, Result
from trouble import Trouble

from mclass.batch.judgement import METRICS, Tolerances, compare, judged, quantities
from mclass.batch.plan import Job, find_logs, plan
from mclass.batch.record import (
    LogResult,
    Status,
    entropy,
    entry_line,
    read_results,
    results_text,
    worst_exit_code,
)
from mclass.batch.run import Criteria, run_batch
from mclass.batch.work import Estimation
from mclass.batch.workers import DiedError, each
from mclass.commands.cli import main
from mclass.config.model_file import parse_model
from mclass.errors import LogError, UsageError
from mclass.model import Model
from mclass.outputs.readback import OutputLog
from mclass.rules import parse_rule

ROOT = Path(__file__).parent.parent
TOY = ROOT / "sample_logs" / "paper_toy.mcap"
LAB = ROOT / "sample_logs" / "cas_lab.mcap"
TOY_MODEL = (
    (ROOT / "configs" / "paper_toy.yaml")
    .read_text()
    .replace("{cell_size: 1, orientation_bins: 360,", "{cell_size: 10, orientation_bins: 8,")
)
"""As coarse as can be: quick."""


def here(
    work: Estimation, jobs: Iterable[Job]
) -> Generator[tuple[Job, LogResult | DiedError], None, None]:
    """Do jobs in this process: quick, where processes are not what is tested."""
    for job in jobs:
        yield job, work(job)


def toy_model(change: str = "") -> Model:
    return parse_model(TOY_MODEL + change, "toy.yaml")


def record_of(entries: Iterable[LogResult]) -> str:
    return results_text(entry_line(entry) for entry in entries)


def command(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["batch", *map(str, arguments)])


def entries_of(folder: Path) -> dict[str, LogResult]:
    return {entry.name: entry for entry in read_results(folder / "results.json")}


def hand_made(name: str = "run", **changes: Any) -> LogResult:
    objects = (
        {
            "id": "o1",
            "class": "door",
            "class_probabilities": {"background": 0.2, "door": 0.7, "box": 0.1},
            "orientation_deg": 350.0,
            "modes": [
                {"orientation_deg": 350.0, "mass": 0.5, "std_deg": 3.0},
                {"orientation_deg": 170.0, "mass": 0.48, "std_deg": 3.0},
                {"orientation_deg": 80.0, "mass": 0.02, "std_deg": 3.0},
            ],
            "entropy": 0.8,
        },
    )
    plain: dict[str, Any] = {"status": "done", "used": 19, "skipped": {"late": 1}}
    entry = LogResult(name, f"../{name}.mcap", f"{name}.mclass.mcap", objects=objects)
    return replace(entry, **{**plain, **changes})


def with_object(result: LogResult, **changes: Any) -> LogResult:
    return replace(result, objects=({**result.objects[0], **changes},))


# Which logs.


def test_logs_of_folders_patterns_and_paths(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    for name in (
        "logs/b.mcap",
        "logs/a.MCAP",
        "logs/deep/er/c.mcap",
        "logs/.hidden.mcap",
        "logs/.trash/d.mcap",
        "logs/a.mclass.mcap",
        "logs/notes.txt",
        "logs/out/own.mcap",
        "more/x1.mcap",
        "more/x2.mcap",
        "more/[odd].mcap",
    ):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()
    own = Path("logs/out")

    def found(*sources: str) -> list[str]:
        return [str(log) for log in find_logs(sources, own)]

    assert found("logs") == ["logs/a.MCAP", "logs/b.mcap", "logs/deep/er/c.mcap"]
    assert found("more/x?.mcap", "more/x1.mcap") == ["more/x1.mcap", "more/x2.mcap"]
    assert found("more/[odd].mcap") == ["more/[odd].mcap"]
    assert found("./more/../more/x1.mcap", "more/x1.mcap") == ["more/../more/x1.mcap"]
    assert found("m*") == ["more/[odd].mcap", "more/x1.mcap", "more/x2.mcap"]
    assert found("logs/**/*.mcap")[-1] == "logs/deep/er/c.mcap"
    assert found("missing.mcap") == ["missing.mcap"]
    for nothing in ("more/y*.mcap", "logs/out"):
        with pytest.raises(UsageError, match=r"nothing|no \.mcap logs"):
            found(nothing)


def test_same_stems_get_distinct_names_that_stay(tmp_path: Path) -> None:
    logs = [tmp_path / name for name in ("a/run.mcap", "b/RUN.mcap", "c/run-2.mcap")]
    jobs = plan(logs, tmp_path / "out", (), overwrite=False)
    names = [job.entry.name for job in jobs]
    assert names == ["run", "RUN-2", "run-2-2"]
    assert [job.entry.input for job in jobs] == [
        "../a/run.mcap",
        "../b/RUN.mcap",
        "../c/run-2.mcap",
    ]
    known = [job.entry for job in jobs]
    more = [tmp_path / "0/run.mcap", *reversed(logs)]
    again = plan(more, tmp_path / "out", known, overwrite=False)
    assert [job.entry.name for job in again] == ["run-3", *reversed(names)]


def test_a_file_that_is_not_from_the_batch_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "toy.mclass.mcap").write_text("mine")
    logs = [tmp_path / "toy.mcap"]
    with pytest.raises(UsageError, match=r"toy\.mclass\.mcap is there.*--overwrite"):
        plan(logs, tmp_path, (), overwrite=False)
    assert len(plan(logs, tmp_path, (), overwrite=True)) == 1


# The whole command.


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of every kind: good ones, two of one name, a cut one, no log, no model."""
    folder = tmp_path_factory.mktemp("fleet")
    (folder / "other").mkdir()
    shutil.copy(TOY, folder / "toy.mcap")
    shutil.copy(TOY, folder / "other" / "toy.mcap")
    shutil.copy(LAB, folder / "lab.mcap")
    (folder / "cut.mcap").write_bytes(TOY.read_bytes()[:-20_000])
    (folder / "none.mcap").write_text("no log")
    return folder


def test_every_log_has_an_outcome(fleet: Path, tmp_path: Path) -> None:
    out, junit = tmp_path / "out", tmp_path / "junit.xml"
    rule = ["--fail-on", "objects < 2"]
    result = command(fleet, "-o", out, "-j", 2, "--junit", junit, *rule)
    assert result.exit_code == 1, result.output
    entries = entries_of(out)
    statuses = {name: entry.status for name, entry in entries.items()}
    assert statuses == {
        "cut": "damaged",
        "lab": "done",
        "none": "failed",
        "toy": "done",
        "toy-2": "done",
    }
    assert "is not an MCAP file" in entries["none"].message
    assert entries["toy"].misses == ("objects is 1 (rule: objects < 2)",)
    assert entries["lab"].misses == ()
    assert entries["cut"].damage
    assert entries["toy-2"].input == os.path.relpath(fleet / "other/toy.mcap", out)
    assert sorted(path.name for path in out.iterdir()) == [
        "cut.mclass.mcap",
        "lab.mclass.mcap",
        "results.json",
        "toy-2.mclass.mcap",
        "toy.mclass.mcap",
    ]
    (entry,) = entries["toy"].objects
    with OutputLog.open(out / "toy.mclass.mcap") as output:
        (stored,) = output.objects()
        assert output.metadata["input_hash"] == entries["toy"].input_hash
        assert output.metadata["model_hash"] == entries["toy"].model_hash
    assert list(entry["class_probabilities"].values()) == stored.class_probabilities.tolist()
    tags = {case.get("name"): [child.tag for child in case] for case in _cases(junit)}
    assert tags["none"][0] == "error"
    assert tags["toy"][0] == "failure"
    assert tags["lab"] == ["system-out"]
    assert "5 logs: 3 done, 1 damaged, 1 failed, 3 missed a threshold" in result.stdout
    assert result.stderr == ""

    again = command(fleet, "-o", out, "--format", "json")
    document = json.loads(again.stdout)
    assert {entry["name"]: entry["reused"] for entry in document["results"]} == {
        "cut": True,
        "lab": True,
        "none": False,
        "toy": True,
        "toy-2": True,
    }
    assert document["exit_code"] == again.exit_code == 1


def _cases(path: Path) -> Iterable[ElementTree.Element]:
    return ElementTree.parse(path).getroot()[0]


@pytest.mark.parametrize(
    ("logs", "options", "code"),
    [
        (["toy.mcap"], [], 0),
        (["toy.mcap", "cut.mcap"], [], 3),
        (["toy.mcap", "cut.mcap"], ["--fail-on", "skipped >= 0 %"], 4),
        (["cut.mcap", "none.mcap"], ["--fail-on", "skipped >= 0 %"], 1),
        (["missing.mcap", "toy.mcap"], [], 1),
        (["toy.mcap"], ["--fail-on", "skiped > 5"], 2),
        (["toy.mcap"], ["--baseline", "no_such.json"], 2),
        (["toy.mcap"], ["-c", "no_such.yaml"], 2),
        (["t*.nothing"], [], 2),
    ],
)
def test_the_worst_exit_code_wins(
    fleet: Path, tmp_path: Path, logs: list[str], options: list[str], code: int
) -> None:
    result = command(*(fleet / log for log in logs), "-o", tmp_path / "out", "-j", 1, *options)
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output


def test_a_log_without_usable_model_is_wrong_usage(tmp_path: Path) -> None:
    done = [hand_made(exit_code=code) for code in (0, 3, 2)]
    assert worst_exit_code(done) == 2
    assert worst_exit_code([*done, hand_made(exit_code=1)]) == 1
    assert worst_exit_code([hand_made(exit_code=3), hand_made(misses=("x",))]) == 4
    assert worst_exit_code([]) == 0


# Going on.


@pytest.fixture
def toys(tmp_path: Path) -> Path:
    folder = tmp_path / "toys"
    folder.mkdir()
    (folder / "mclass.yaml").write_text(TOY_MODEL)
    for name in ("one", "two"):
        shutil.copy(TOY, folder / f"{name}.mcap")
    return folder


def run_here(toys: Path, out: Path, **changes: Any) -> dict[str, bool]:
    """Whether each log's earlier result was kept."""
    arguments: dict[str, Any] = {"model": toy_model(), **changes}
    report = run_batch([str(toys)], out, Estimation(**arguments), executor=here)
    assert report.exit_code == 0, report.results
    return {result.name: result.reused for result in report.results}


def test_done_logs_are_kept_until_something_changes(
    toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    kept, done = {"one": True, "two": True}, {"one": False, "two": False}
    assert run_here(toys, out) == done
    assert run_here(toys, out) == kept
    assert run_here(toys, out, anew=True) == done
    # Another log under an old name; another that was merely touched.
    shutil.copy(ROOT / "sample_logs" / "cas_lab.mcap", toys / "one.mcap")
    os.utime(toys / "two.mcap", (0, 0))
    report = run_batch([str(toys)], out, Estimation(toy_model()), executor=here)
    assert [(result.status, result.reused) for result in report.results] == [
        ("failed", False),
        ("done", True),
    ]
    shutil.copy(TOY, toys / "one.mcap")
    assert run_here(toys, out) == {"one": False, "two": True}
    assert run_here(toys, out) == kept
    (out / "two.mclass.mcap").unlink()
    assert run_here(toys, out) == {"one": True, "two": False}
    os.truncate(out / "one.mclass.mcap", 100)
    assert run_here(toys, out) == {"one": False, "two": True}
    assert run_here(toys, out, every_s=1.0) == done
    assert run_here(toys, out, every_s=1.0) == kept
    assert run_here(toys, out, model=toy_model("# another text")) == done
    assert run_here(toys, out) == done
    monkeypatch.setattr("mclass.__version__", "99")
    assert run_here(toys, out) == done


def test_entries_of_other_logs_stay_in_the_record(toys: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run_here(toys, out)
    shutil.copy(TOY, tmp_path / "later.mcap")
    assert run_here(tmp_path / "later.mcap", out) == {"later": False}
    assert list(entries_of(out)) == ["one", "two", "later"]


def test_logs_and_results_can_be_moved_together(toys: Path, tmp_path: Path) -> None:
    run_here(toys, tmp_path / "out")
    moved = tmp_path / "moved"
    moved.mkdir()
    shutil.move(toys, moved)
    shutil.move(tmp_path / "out", moved)
    assert run_here(moved / "toys", moved / "out") == {"one": True, "two": True}


def start(*arguments: object) -> subprocess.Popen[str]:
    code = "from mclass.commands.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, "batch", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def wait_for_entries(path: Path, count: int) -> None:
    """Until so many logs are done by the record."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with contextlib.suppress(UsageError):
            if sum(entry.has_results for entry in read_results(path)) >= count:
                return
        time.sleep(0.02)
    raise AssertionError("the batch does not get on")


@pytest.mark.parametrize(
    "sign",
    [
        signal.SIGINT,
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, marks=pytest.mark.slow),
    ],
)
def test_interrupted_at_any_time_it_goes_on(tmp_path: Path, sign: signal.Signals) -> None:
    count = 40  # few would be done before the signal comes
    logs, out = tmp_path / "logs", tmp_path / "out"
    logs.mkdir()
    (logs / "mclass.yaml").write_text(TOY_MODEL)
    for index in range(count):
        shutil.copy(TOY, logs / f"{index}.mcap")
    process = start(logs, "-o", out, "-j", 1)
    wait_for_entries(out / "results.json", 1)
    # As a terminal does: to the program and all its processes.
    if sign == signal.SIGINT:
        os.killpg(process.pid, sign)
    else:
        process.send_signal(sign)
    _, told = process.communicate(timeout=60)
    entries = entries_of(out)
    assert len(entries) == count
    finished = [entry for entry in entries.values() if entry.has_results]
    assert 1 <= len(finished) < count
    if sign != signal.SIGKILL:
        assert process.returncode == 130
        assert f"of {count} logs are done and recorded" in told
        files = {path.name for path in out.iterdir()}
        assert files == {"results.json", *(entry.output for entry in finished)}
    for entry in finished:
        with OutputLog.open(out / entry.output) as output:
            assert len(output.objects()) == 1
    while True:  # those that outlive their parent end by themselves
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            break
        time.sleep(0.05)
    (out / ".0.mclass.mcap.part-1").touch()
    report = run_batch([str(logs)], out, Estimation(None), executor=here)
    assert report.exit_code == 0
    assert sum(result.reused for result in report.results) == len(finished)
    assert len(list(out.iterdir())) == count + 1


def test_two_batches_do_not_share_a_folder(toys: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def meanwhile(
        work: Estimation, jobs: Iterable[Job]
    ) -> Generator[tuple[Job, LogResult | DiedError], None, None]:
        with pytest.raises(LogError, match="another batch"):
            run_batch([str(toys)], out, work, executor=here)
        yield from here(work, jobs)

    report = run_batch([str(toys)], out, Estimation(None), executor=meanwhile)
    assert report.exit_code == 0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        '{"format": "mclass batch 1"}',
        '{"format": "mclass batch 1", "results": [{}]}',
        '{"format": "mclass batch 1", "results": 3}',
        '{"format": "mclass batch 1", "results": [NaN]}',
        "[" * 100_000,
        record_of([replace(hand_made(), output="../../etc/passwd")]),
    ],
)
def test_a_foreign_record_is_refused(toys: Path, tmp_path: Path, text: str) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "results.json").write_text(text)
    with pytest.raises(UsageError, match="not the results of a batch"):
        run_batch([str(toys)], out, Estimation(None), executor=here)
    assert (out / "results.json").read_text() == text


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    entries = (
        hand_made("a", damage=("lost",), misses=("m",), settings={"start": None}),
        LogResult("b", "../b.mcap", "b.mclass.mcap", "failed", 1, "why \udcff\n"),
    )
    path.write_text(record_of(entries))
    assert read_results(path) == entries


# Processes.


@pytest.mark.parametrize("processes", [1, 3])
def test_the_death_of_a_process_costs_one_job(
    processes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    found = dict(each(Trouble(), range(9), processes))
    assert "ended by SIGKILL (out of memory?" in str(found.pop(3))
    assert str(found.pop(5)) == "its process ended with code 7"
    assert found == {job: (2 * job, "1") for job in (0, 1, 2, 4, 6, 7, 8)}
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_no_jobs_need_no_processes() -> None:
    assert list(each(Trouble(), [], 4)) == []


def test_a_log_whose_process_died_is_a_failed_log(toys: Path, tmp_path: Path) -> None:
    def deadly(
        work: Estimation, jobs: Iterable[Job]
    ) -> Generator[tuple[Job, LogResult | DiedError], None, None]:
        for number, job in enumerate(jobs):
            yield job, work(job) if number else DiedError("its process was ended by SIGKILL")

    out = tmp_path / "out"
    report = run_batch([str(toys)], out, Estimation(None), executor=deadly)
    assert report.exit_code == 1
    assert entries_of(out)["one"].status == "failed"
    assert "one.mcap: its process was ended by SIGKILL" in entries_of(out)["one"].message
    assert entries_of(out)["two"].status == "done"


@pytest.mark.slow
def test_ten_thousand_logs_take_little_memory_and_time(tmp_path: Path) -> None:
    jobs = 10_000
    logs = tmp_path / "logs"
    logs.mkdir()
    for index in range(jobs):
        (logs / f"{index}.mcap").touch()

    def done_at_once(
        work: Estimation, jobs: Iterable[Job]
    ) -> Generator[tuple[Job, LogResult | DiedError], None, None]:
        for job in jobs:
            yield job, hand_made(job.entry.name, input=job.entry.input, output=job.entry.output)

    for _ in range(2):  # the second time with a record to begin with
        tracemalloc.start()
        began = time.process_time()
        report = run_batch([str(logs)], tmp_path / "out", Estimation(None), executor=done_at_once)
        seconds = time.process_time() - began
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert len(report.results) == jobs
        assert kept / jobs < 4_000
        # Tracing makes everything several times slower.
        assert seconds / jobs < 0.02


# Judgement.


def test_figures_by_hand() -> None:
    second = {**hand_made().objects[0], "id": "o2", "entropy": 0.2, "tie": ["door", "box"]}
    second["class_probabilities"] = {"background": 0.5, "door": 0.25, "box": 0.25}
    result = hand_made(objects=(*hand_made().objects, second), damage=("x",), seconds=1.5)
    found = {name: quantity.value for name, quantity in quantities(result).items()}
    assert found == {
        "skipped": 1,
        "used": 19,
        "objects": 2,
        "entropy": 0.8,
        "mean_entropy": 0.5,
        "background": 1,
        "ties": 1,
        "damage": 1,
        "seconds": 1.5,
    }
    assert set(found) == set(METRICS)


def test_entropy_by_hand() -> None:
    assert entropy(np.array([0.0, 1.0])) == 0.0
    assert entropy(np.full(4, 0.25)) == pytest.approx(np.log(4))


@pytest.mark.parametrize(
    ("rule", "missed"),
    [
        ("skipped > 5 %", False),
        ("skipped >= 5 %", True),
        ("used < 20", True),
        ("background > 0 %", False),
        ("entropy > 0.5", True),
    ],
)
def test_rules_judge_a_log(rule: str, missed: bool) -> None:
    assert bool(judged(hand_made(), [parse_rule(rule, METRICS)]).misses) == missed


def test_rules_are_strict_without_objects_and_silent_on_failed_logs() -> None:
    rules = [parse_rule("entropy > 0.5", METRICS)]
    assert judged(hand_made(objects=()), rules).misses
    assert not judged(hand_made(status="failed", objects=()), rules).misses


STATUSES: Sequence[tuple[Status, bool]] = [("done", False), ("failed", True)]


@pytest.mark.parametrize(("status", "regression"), STATUSES)
def test_logs_that_come_and_fail(status: Status, regression: bool) -> None:
    now = [hand_made("a", status=status), hand_made("new")]
    before = [hand_made("a"), hand_made("gone"), hand_made("bad", status="failed")]
    changes = compare(now, before, Tolerances())
    assert {change.name: change.regression for change in changes} == {
        "gone": False,
        "new": False,
        **({"a": True} if regression else {}),
    }


@pytest.mark.parametrize(
    ("changes", "sentence", "regression"),
    [
        ({"class": "box"}, "is box, was door", True),
        ({"class": "box", "tie": ["door", "box"]}, "(a tie)", False),
        ({"orientation_deg": 356.0}, "turned by 6.0 deg, to 356.0 deg", True),
        ({"orientation_deg": 344.0}, "turned by 6.0 deg", True),
        ({"orientation_deg": 80.0}, "turned by 90.0 deg", True),
        ({"entropy": 0.86}, "less certain: entropy 0.860, was 0.800", True),
        ({"id": "o2"}, "'o1' is missing", True),
    ],
)
def test_changes_of_an_object(changes: dict[str, Any], sentence: str, regression: bool) -> None:
    found = compare([with_object(hand_made(), **changes)], [hand_made()], Tolerances())
    assert sentence in found[0].sentence
    assert found[0].regression == regression


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"orientation_deg": 354.9},
        {"orientation_deg": 172.0},
        {"entropy": 0.84},
        {"entropy": 0.1},
        {"class_probabilities": {"background": 0.0, "door": 1.0, "box": 0.0}},
    ],
)
def test_what_is_within_tolerance_is_no_change(changes: dict[str, Any]) -> None:
    assert compare([with_object(hand_made(), **changes)], [hand_made()], Tolerances()) == []


def test_a_regression_is_exit_code_4_and_recorded(toys: Path, tmp_path: Path) -> None:
    first = run_batch([str(toys)], tmp_path / "first", Estimation(None), executor=here)
    tampered = [with_object(entry, orientation_deg=0.0, modes=[]) for entry in first.results[:1]]
    baseline = tmp_path / "baseline.json"
    baseline.write_text(record_of([*tampered, *first.results[1:]]))
    out = tmp_path / "out"
    result = command(toys, "-o", out, "-j", 1, "--baseline", baseline)
    assert result.exit_code == 4, result.output
    assert "one: since the baseline: object 'o1' turned by 45.0 deg" in result.stdout
    assert [bool(entry.misses) for entry in entries_of(out).values()] == [True, False]
    wide = command(toys, "-o", out, "--baseline", baseline, "--orientation-tolerance", 50)
    assert wide.exit_code == 0


def test_progress_counts_every_log(toys: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int, str]] = []
    run_batch(
        [str(toys)],
        tmp_path / "out",
        Estimation(None),
        executor=here,
        criteria=Criteria(),
        progress=lambda done, total, result: seen.append(
            (done, total, result.name if result else "")
        ),
    )
    assert seen == [(0, 2, ""), (1, 2, "one"), (2, 2, "two")]
