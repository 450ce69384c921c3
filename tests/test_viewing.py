"""Recordings for Rerun, read back with Rerun's own reader and compared with the output."""

from __future__ import annotations

import builtins
import importlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from click.testing import CliRunner

from mclass import estimate, infer, load_model, measurements_from_arrays
from mclass.commands.cli import main
from mclass.errors import LogError, UsageError
from mclass.evaluation.density import joint_density
from mclass.inspection import look_into
from mclass.outputs.readback import OutputLog
from mclass.summary import Readout, orientation_densities

rerun_chunk = pytest.importorskip("rerun.chunk")

from mclass.viewing import save_recording  # noqa: E402 (needs Rerun)
from mclass.viewing.contents import BINS, gather  # noqa: E402

ROOT = Path(__file__).parents[1]


class Recording:
    """Columns of a recording: what was sent, by entity."""

    def __init__(self, path: Path) -> None:
        reader = rerun_chunk.RrdReader(path)
        assert len(reader.recordings()) == 1
        assert len(reader.blueprints()) == 1
        self.rows: dict[str, list[dict[str, Any]]] = {}
        for chunk in reader.stream().to_chunks():
            assert chunk.is_static or list(chunk.timeline_names) == ["stamp"]
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            for row in range(chunk.num_rows):
                values = {
                    name.split(":")[-1]: column[row]
                    for name, column in columns.items()
                    if "RowId" not in name
                }
                self.rows.setdefault(chunk.entity_path, []).append(values)

    def values(self, entity: str, component: str) -> list[Any]:
        """All values of a component over time, in the order in which they were sent."""
        return [
            row[component].as_py()
            for row in self.rows[entity]
            if "stamp" in row and component in row
        ]

    def stamps(self, entity: str) -> list[int]:
        """Nanoseconds of all rows."""
        return [row["stamp"].value for row in self.rows[entity] if "stamp" in row]

    def static(self, entity: str, component: str) -> Any:
        """The value of a component that holds at all times."""
        return next(
            row[component].as_py()
            for row in self.rows[entity]
            if "stamp" not in row and component in row
        )


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[OutputLog, Recording, Path]]:
    """The laboratory's output with maps over time, and its recording."""
    folder = tmp_path_factory.mktemp("lab")
    out, saved = folder / "out.mcap", folder / "out.rrd"
    estimate(ROOT / "sample_logs/cas_lab.mcap", output=out, every_s=10.0)
    save_recording(out, saved)
    with OutputLog.open(out) as output:
        yield output, Recording(saved), out


def test_probabilities_and_stamps_are_the_outputs(
    lab: tuple[OutputLog, Recording, Path],
) -> None:
    output, recording, _ = lab
    history = output.history()
    assert len(history) == 3
    for object_id, steps in history.items():
        path = f"/objects/{object_id}/probability"
        assert recording.stamps(path) == [step.stamp_ns for step in steps]
        expected = [step.class_probabilities.tolist() for step in steps]
        assert recording.values(path, "scalars") == expected
    names = recording.static("/objects/o1/probability", "names")
    assert names[:3] == ["background", "physics_books", "robot_parts"]


def test_places_and_modes_are_the_outputs(lab: tuple[OutputLog, Recording, Path]) -> None:
    output, recording, _ = lab
    for object_id, steps in output.history().items():
        path = f"/world/objects/{object_id}"
        centers = np.array(recording.values(path, "centers"))[:, 0, :2]
        np.testing.assert_allclose(centers, [step.position for step in steps], rtol=1e-6)
        vectors = recording.values(f"{path}/modes", "vectors")
        for drawn, step in zip(vectors, steps, strict=True):
            x, y, _ = np.array(drawn).T
            angles = np.arctan2(y, x) % (2.0 * np.pi)
            np.testing.assert_allclose(angles, [m.orientation for m in step.modes], atol=1e-6)
        labels = recording.values(f"{path}/name", "labels")
        assert [one[0].split("\n")[0] for one in labels] == [object_id] * len(steps)


def test_maps_are_the_outputs(lab: tuple[OutputLog, Recording, Path]) -> None:
    output, recording, _ = lab
    maps = output.maps_over_time(100)
    assert len(maps) > 2
    for index, name in enumerate(("background", *output.class_names)):
        path = f"/world/map/{name}"
        assert recording.stamps(path) == [shown.stamp_ns for shown in maps]
        for shown, row in zip(maps, recording.rows[path], strict=True):
            grid = shown.grid
            (form,) = row["format"].as_py()
            assert (form["width"], form["height"]) == (grid.columns, grid.rows)
            image = _image(row, np.float32).reshape(grid.rows, grid.columns)
            # The image's uppermost row has the greatest y.
            rows, columns = np.divmod(shown.cells, grid.columns)
            np.testing.assert_allclose(
                image[grid.rows - 1 - rows, columns],
                shown.class_probabilities[:, index],
                atol=1e-7,
            )
            (corner,) = row["translation"].as_py()
            np.testing.assert_allclose(corner, [*grid.origin, 0.0], atol=1e-6)
            assert row["cell_size"].as_py() == [pytest.approx(grid.cell_size)]


def test_cells_never_seen_are_transparent(lab: tuple[OutputLog, Recording, Path]) -> None:
    output, recording, _ = lab
    shown = output.maps()
    opacity = _image(recording.rows["/world/map/all"][-1], np.uint8).reshape(-1, 4)[:, 3]
    grid = shown.grid
    seen = np.flatnonzero(opacity.reshape(grid.rows, grid.columns)[::-1].ravel())
    np.testing.assert_array_equal(seen, shown.cells)


def test_densities_end_as_the_stored_beliefs(lab: tuple[OutputLog, Recording, Path]) -> None:
    output, recording, _ = lab
    for estimate_ in output.objects():
        stored = joint_density(output.belief(estimate_.object_id))
        angles = np.arange(BINS) / BINS
        every = np.arange(stored.log_density.shape[1]) / stored.log_density.shape[1]
        for index, name in enumerate(output.class_names):
            path = f"/objects/{estimate_.object_id}/orientation/{name}"
            drawn = np.array(recording.values(path, "values")[-1][0]["buffer"])
            curve = np.exp(stored.log_class[1 + index] + stored.log_density[index])
            expected = np.interp(angles, every, curve, period=1.0)
            np.testing.assert_allclose(drawn, expected, atol=1e-4)


def test_densities_over_time_are_those_of_inspect(
    lab: tuple[OutputLog, Recording, Path],
) -> None:
    """At a known position the belief of its one cell is the object's."""
    output, recording, out = lab
    found = look_into(out, 4.0, 2.0, "o1", history=True)
    assert len(found.history) == 2
    for index, name in enumerate(output.class_names):
        drawn = recording.values(f"/objects/o1/orientation/{name}", "values")
        for step, values in zip(found.history, drawn, strict=True):
            expected = step.class_probabilities[1 + index] * step.density[index]
            every = np.arange(len(expected)) / len(expected)
            at = np.interp(np.arange(BINS) / BINS, every, expected, period=1.0)
            np.testing.assert_allclose(values[0]["buffer"], at, atol=2e-3)


def test_detections_point_where_they_did(lab: tuple[OutputLog, Recording, Path]) -> None:
    output, recording, _ = lab
    found = output.measurements()
    strips = recording.values("/world/detections/now", "strips")
    assert recording.stamps("/world/detections/now") == found.frames.stamps_ns.tolist()
    for row, frame in enumerate(found.frame_index.tolist()):
        ((right, sensor, left),) = strips[frame]
        np.testing.assert_allclose(sensor[:2], found.frames.poses_world_sensor[frame, :2], 1e-5)
        drawn = [np.arctan2(end[1] - sensor[1], end[0] - sensor[0]) for end in (right, left)]
        np.testing.assert_allclose(drawn, found.directions[row], atol=1e-5)
    assert recording.values("/detections/labels", "text")[0] == ["o2: physics_books, robot_parts"]


def test_the_track_is_the_logs_own(lab: tuple[OutputLog, Recording, Path]) -> None:
    _, recording, _ = lab
    (line,) = recording.static("/world/track", "strips")
    origins = recording.values("/world/robot", "origins")
    assert len(line) == len(origins) > 1000
    np.testing.assert_allclose(line[0][:2], [0.0, 0.0], atol=1e-6)


def _image(row: Mapping[str, Any], dtype: Any) -> npt.NDArray[Any]:
    return np.frombuffer(bytes(row["data"].as_py()[0]), dtype)


def scattered(
    path: Path, count: int = 3, offset: float = 0.0, names: Sequence[str | None] = ()
) -> None:
    """An output of objects in a row, one detection each, with paper_toy's two classes."""
    model = load_model(ROOT / "configs/paper_toy.yaml")
    ids = list(names or [f"o{k}" for k in range(count)])
    measurements = measurements_from_arrays(
        poses=[[offset + float(k), offset, 0.0] for k in range(count)],
        labels=[["c1"]] * count,
        label_names=model.classes.label_names,
        object_ids=ids,
        directions=[[1.4, 1.6]] * count,
        stamps_ns=[10**18 + k for k in range(count)],
    )
    infer(measurements, model, output=path)


def test_far_from_the_origin_places_keep_their_millimetres(tmp_path: Path) -> None:
    out, saved = tmp_path / "far.mcap", tmp_path / "far.rrd"
    scattered(out, offset=1_000_000.3)
    save_recording(out, saved)
    with OutputLog.open(out) as output:
        contents = gather(output)
        history = output.history()
    np.testing.assert_array_equal(contents.origin, [1e6, 1e6])
    recording = Recording(saved)
    for object_id, steps in history.items():
        center = np.array(recording.values(f"/world/objects/{object_id}", "centers"))[0, 0, :2]
        np.testing.assert_allclose(center, steps[0].position - 1e6, atol=1e-5)
    (about,) = recording.static("/about", "text")
    assert "less x 1000000 m, y 1000000 m" in about


def test_names_may_be_anything(tmp_path: Path) -> None:
    out, saved = tmp_path / "names.mcap", tmp_path / "names.rrd"
    names = ["a/b c", "a b/c", "größe " + 300 * "x"]
    scattered(out, names=names)
    save_recording(out, saved)
    entities = {path for path in Recording(saved).rows if path.endswith("/probability")}
    assert len(entities) == 3


def test_no_objects(tmp_path: Path) -> None:
    out, saved = tmp_path / "none.mcap", tmp_path / "none.rrd"
    scattered(out, names=[None, None, None])
    shown = save_recording(out, saved)
    assert not shown.contents.objects
    assert len(Recording(saved).rows["/world/map/all"]) == 1


def test_densities_by_hand() -> None:
    """Two cells of equal mass, one flat, one with all mass around 90 degrees of class one."""
    bins = 8
    angles = 2.0 * np.pi * np.arange(bins) / bins
    likelihood = np.zeros((2, 2, bins))
    likelihood[1, 0] = 2.0 * np.cos(angles - 0.5 * np.pi)
    mass = np.log(np.mean(np.exp(likelihood), axis=-1))
    outer = np.zeros((2, 2))
    joint = np.concatenate([np.zeros((2, 1)), mass + outer], axis=1)
    found = orientation_densities(Readout(likelihood, outer, joint, np.zeros((2, 2))), 4)
    # exp(2 cos) integrates to 2 pi I0(2) = 2 pi 2.2795853; the flat cell to 2 pi.
    total = 2.0 * np.pi * (1.0 + 2.2795853)
    expected = (1.0 + np.exp([0.0, 2.0, 0.0, -2.0])) / total
    np.testing.assert_allclose(found[0], expected, rtol=1e-3)
    np.testing.assert_allclose(found[1], 1.0 / (2.0 * np.pi))


class TestCommand:
    def test_saves_and_says_so(self, lab: tuple[OutputLog, Recording, Path]) -> None:
        out = lab[2]
        saved = out.with_name("again.rrd")
        done = CliRunner().invoke(main, ["view", str(out), "--save", str(saved)])
        assert done.exit_code == 0, done.output
        assert f"{saved}: 3 objects, 5 measurements, " in done.stdout
        assert saved.stat().st_size > 10_000
        again = CliRunner().invoke(main, ["view", str(out), "--save", str(saved)])
        assert again.exit_code == 1
        assert "--overwrite" in again.stderr
        third = CliRunner().invoke(main, ["view", str(out), "--save", str(saved), "--overwrite"])
        assert third.exit_code == 0, third.output
        assert {path.name for path in out.parent.iterdir()} == {"out.mcap", "out.rrd", "again.rrd"}

    def test_the_output_itself_is_safe(self, lab: tuple[OutputLog, Recording, Path]) -> None:
        out = lab[2]
        with pytest.raises(LogError, match="is the input itself"):
            save_recording(out, out, overwrite=True)

    def test_without_a_display(
        self, lab: tuple[OutputLog, Recording, Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "platform", "linux")
        monkeypatch.delenv("DISPLAY", raising=False)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        done = CliRunner().invoke(main, ["view", str(lab[2])])
        assert done.exit_code == 2
        assert "no display" in done.stderr
        assert "--save" in done.stderr


def test_a_log_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="run `mclass estimate` first"):
        save_recording(ROOT / "sample_logs/cas_lab.mcap", tmp_path / "x.rrd")
    assert not list(tmp_path.iterdir())


def test_without_rerun_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("mclass.viewing")]:
        monkeypatch.delitem(sys.modules, name)
    importing = builtins.__import__

    def without_rerun(name: str, *arguments: Any, **settings: Any) -> Any:
        if name.split(".", maxsplit=1)[0] == "rerun":
            raise ImportError("No module named 'rerun'")
        return importing(name, *arguments, **settings)

    monkeypatch.setattr(builtins, "__import__", without_rerun)
    with pytest.raises(UsageError, match=r"pip install 'mclass\[view\]'"):
        importlib.import_module("mclass.viewing")
