"""The page's document says what the output says; the page is small, safe and always the same."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lopsided_results import CLASS_NAMES, STAMP_NS, estimate, maps
from numpy.testing import assert_allclose, assert_array_equal
from sample_runs import ROOT, SAMPLES, estimated, mclass
from written_output import belief, measurements, model, write_everything

from mclass.cells import stored_report
from mclass.footprint import Grid
from mclass.logs.writer import LogWriter
from mclass.outputs.channels import OutputChannels
from mclass.outputs.readback import OutputLog
from mclass.records import FloatArray, Frames, LabelMeasurements
from mclass.report import maps as report_maps
from mclass.report.document import report_document
from mclass.report.maps import NOTHING, CellFacts, highest_degrees, pack_maps
from mclass.report.page import SCRIPTS, json_data
from mclass.report.timeline import Steps, object_document
from mclass.results import BeliefBlock, ClassMaps

WEB = ROOT / "mclass" / "report" / "web"
HOSTILE = "</script><img src=x onerror=alert(1)>&<!--{{script}}"


def document_of(path: Path) -> dict[str, Any]:
    with OutputLog.open(path) as output:
        return report_document(output)


def document_in(page: Path) -> dict[str, Any]:
    """The document that a page holds, as a browser takes it out."""
    text = page.read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="document">(.*?)</script>', text)
    assert found is not None
    document: dict[str, Any] = json.loads(found[1])
    return document


def unpacked(packed: dict[str, Any], classes: int) -> Any:
    """Planes of every map, (maps, 2 + 2 classes, rows, columns)."""
    data = zlib.decompress(base64.b64decode(packed["data"]))
    halves = np.frombuffer(data, np.uint8).astype(np.uint16).reshape(2, -1)
    shape = (-1, 2 * (classes + 1), packed["rows"], packed["columns"])
    steps = (halves[0] + 256 * halves[1]).reshape(shape)
    return np.cumsum(steps, axis=0, dtype=np.uint16)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return estimated("cas_lab", tmp_path_factory.mktemp("lab"), "--every", "10")


@pytest.fixture(scope="module")
def lab_document(lab: Path) -> dict[str, Any]:
    return document_of(lab)


class TestDocument:
    def test_objects_are_those_of_the_output(self, lab: Path, lab_document: Any) -> None:
        with OutputLog.open(lab) as output:
            history, stamps = output.history(), output.measurements().stamps_ns
        assert [entry["name"] for entry in lab_document["objects"]] == ["o1", "o2", "o3"]
        for entry in lab_document["objects"]:
            expected = history[entry["name"]]
            assert entry["measurements"] == len(expected) == len(entry["updates"])
            for update, found in zip(entry["updates"], expected, strict=True):
                assert stamps[update["step"]] == found.stamp_ns
                assert update["n"] == found.measurements
                assert update["class"] == found.class_index
                assert_allclose(update["p"], found.class_probabilities, rtol=1e-5)
                place = [*found.position, *found.position_std]
                assert_allclose(update["place"], place, rtol=1e-5)
                assert_allclose(
                    sorted(mode[0] for mode in update["modes"]),
                    sorted(np.degrees([mode.orientation for mode in found.modes])),
                    atol=1e-3,
                )

    def test_steps_are_the_measurements(self, lab: Path, lab_document: Any) -> None:
        with OutputLog.open(lab) as output:
            found = output.measurements()
        steps = lab_document["steps"]
        assert steps["total"] == len(found) == len(steps["seconds"]) == 5
        assert_allclose(steps["seconds"], (found.stamps_ns - found.stamps_ns[0]) / 1e9, atol=5e-4)
        poses = found.frames.poses_world_sensor[found.frame_index]
        assert_allclose(steps["x"], poses[:, 0], atol=5e-4)
        assert_allclose(steps["heading"], poses[:, 2], atol=5e-5)
        assert_allclose(steps["right"], found.directions[:, 0], atol=5e-5)
        names = [lab_document["objects"][index]["name"] for index in steps["object"]]
        assert names == [found.object_ids[index] for index in found.object_index]
        labels = [steps["label_sets"][index] for index in steps["labels"]]
        assert labels == [", ".join(found.label_names_of(row)) for row in range(5)]

    def test_maps_are_those_of_the_output(self, lab: Path, lab_document: Any) -> None:
        with OutputLog.open(lab) as output:
            stored = output.maps_over_time(99)
        packed = lab_document["map"]
        assert len(packed["seconds"]) == packed["stored"] == len(stored) > 2
        planes = unpacked(packed, 2)
        for index, found in enumerate(stored):
            row, column = np.divmod(found.cells, found.grid.columns)
            row, column = row - packed["first_row"], column - packed["first_column"]
            probabilities = planes[index, :3, row, column] / packed["scale"]
            assert_allclose(probabilities, found.class_probabilities, atol=0.51e-4)
            assert int((planes[index, 0] != NOTHING).sum()) == len(found.cells)
            corner = found.grid.centers(found.cells[:1])[0] - found.grid.cell_size / 2
            size = packed["cell_size"]
            assert_allclose(packed["origin"] + size * np.array([column[0], row[0]]), corner)

    def test_cells_face_where_their_belief_peaks(self, lab: Path, lab_document: Any) -> None:
        packed = lab_document["map"]
        last = unpacked(packed, 2)[-1]
        compared = 0
        with OutputLog.open(lab) as output:
            blocks = output.belief()
        for block in blocks:
            for index, cell in enumerate(block.cells[::7].tolist()):
                report = stored_report(block, cell)
                row = report.row - packed["first_row"]
                column = report.column - packed["first_column"]
                assert last[5, row, column] == block.measurements[::7][index]
                for position, density in enumerate(report.density):
                    angle = int(last[3 + position, row, column])
                    if angle == NOTHING:
                        assert np.ptp(np.log(density)) < 0.02
                        continue
                    at = round(angle / 360.0 * len(density)) % len(density)
                    assert density[at] > 0.97 * density.max()
                    compared += 1
        assert compared > 50

    def test_densities_are_of_the_whole_belief(self, lab: Path, lab_document: Any) -> None:
        entry = lab_document["objects"][0]
        assert entry["density"]["measurements"] == entry["measurements"]
        density = np.array(entry["density"]["classes"])
        assert_allclose(density.mean(axis=1) * 2.0 * np.pi, 1.0, rtol=2e-3)
        with OutputLog.open(lab) as output:
            (block,) = output.belief("o1")
        # At a known position there is one cell.
        assert_allclose(density, np.exp(block.log_density[0]), rtol=1e-3, atol=1e-30)

    def test_track_is_the_log_s_own(self, lab_document: Any) -> None:
        track = lab_document["track"]
        assert track["name"] == "base_link"
        assert len(track["x"]) == len(track["y"]) == len(track["seconds"]) > 1000
        assert track["seconds"][0] < 0 < track["seconds"][-1]

    def test_says_what_was_used_and_why_not_the_rest(self, lab_document: Any) -> None:
        facts = lab_document["facts"]
        assert facts["used"] == 5
        assert facts["skipped"] == []
        assert "poses: /odom (Odometry)" in facts["notes"]
        assert facts["model_name"] == "cas_lab.mcap#mclass.yaml"
        assert "physics_books:" in facts["model_text"]
        assert facts["version"]
        assert [name for name, _ in facts["hashes"]] == ["model", "input"]
        assert ["every_s", "10.0"] in facts["settings"]

    def test_without_the_log_the_sensor_s_places_are_the_track(self, tmp_path: Path) -> None:
        output = estimated("cas_lab", tmp_path, "--only-new")
        track = document_of(output)["track"]
        assert track["name"] == "sensor"
        with OutputLog.open(output) as found:
            poses = found.measurements().frames.poses_world_sensor
        assert_allclose(track["x"], poses[:, 0], atol=5e-4)

    def test_joined_maps_have_no_track_of_the_robot(self, lab: Path, tmp_path: Path) -> None:
        mclass("fuse", lab, "-o", tmp_path / "map.mcap")
        document = document_of(tmp_path / "map.mcap")
        assert document["track"]["name"] == "sensor"
        assert document["facts"]["used"] == 5

    @pytest.mark.parametrize("encoding", ["ros2", "protobuf", "json"])
    def test_all_encodings_and_strange_ids(self, encoding: Any, tmp_path: Path) -> None:
        write_everything(tmp_path / "out.mcap", encoding)
        document = document_of(tmp_path / "out.mcap")
        assert [entry["name"] for entry in document["objects"]] == ["box 1/a\\n\\x07é", "o1"]
        assert document["objects"][0]["updates"][-1]["tie"] == [0, 1]
        assert document["facts"]["used"] is None
        assert document["steps"]["right"][1] is None

    def test_nothing_found_is_a_page_too(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "out.mcap", profile="ros2") as writer:
            channels = OutputChannels(writer, "ros2", "odom", model())
            channels.write_header(0)
            none = measurements(frames=0)
            channels.write_measurements(replace(none, label_offsets=np.zeros(1, dtype=np.int64)))
        document = document_of(tmp_path / "out.mcap")
        assert document["map"] is None
        assert document["objects"] == []
        assert document["steps"]["seconds"] == document["track"]["x"] == []


def many(count: int, object_ids: tuple[str, ...] = ("a", "b")) -> LabelMeasurements:
    """So many measurements of the objects in turn, a second apart."""
    rows = np.arange(count)
    return LabelMeasurements(
        frames=Frames(
            stamps_ns=STAMP_NS + rows * 10**9,
            log_times_ns=STAMP_NS + rows * 10**9,
            poses_world_sensor=np.stack([rows * 0.01, rows * -0.02, rows * 0.1], axis=1),
            covariances=None,
            view_directions=np.full((count, 2), np.nan),
        ),
        frame_index=rows,
        directions=np.stack([rows * 0.1, rows * 0.1 + 0.2], axis=1),
        object_index=rows % len(object_ids),
        object_ids=object_ids,
        label_offsets=np.arange(count + 1),
        labels=np.zeros(count, dtype=np.int64),
        scores=np.ones(count),
        label_names=("books",),
    )


class TestSteps:
    @pytest.mark.parametrize(
        ("count", "most", "expected"),
        [(0, 5, []), (3, 5, [0, 1, 2]), (10, 3, [3, 6, 9]), (7, 1, [6])],
    )
    def test_evenly_chosen_with_the_last(self, count: int, most: int, expected: list[int]) -> None:
        assert Steps(many(count), most).rows.tolist() == expected

    def test_estimates_find_their_measurement(self) -> None:
        steps = Steps(many(6))
        found = [estimate("b", stamp_ns=STAMP_NS + second * 10**9) for second in (1, 3, 5)]
        assert steps.of(found).tolist() == [1, 3, 5]

    def test_estimates_of_one_stamp_come_one_after_the_other(self) -> None:
        rows = many(4, ("a",))
        frames = replace(rows.frames, stamps_ns=STAMP_NS + np.array([0, 10, 10, 20]))
        steps = Steps(replace(rows, frames=frames))
        found = [estimate("a", stamp_ns=STAMP_NS + after) for after in (0, 10, 10, 20)]
        assert steps.of(found).tolist() == [0, 1, 2, 3]

    def test_objects_without_ids_are_placed_by_stamp(self) -> None:
        rows = many(4)
        steps = Steps(replace(rows, object_index=np.full(4, -1)))
        found = [estimate("object-1", stamp_ns=STAMP_NS + second * 10**9) for second in (0, 2)]
        assert steps.of(found).tolist() == [0, 2]

    def test_of_the_estimates_of_one_step_the_last_stays(self) -> None:
        steps = Steps(many(10, ("a",)), most=3)
        found = [
            estimate("a", stamp_ns=STAMP_NS + second * 10**9, measurements=second + 1)
            for second in range(10)
        ]
        updates = object_document(found, steps.of(found))["updates"]
        # The slider stops after the fourth, the seventh and the tenth.
        assert [(update["step"], update["n"]) for update in updates] == [(0, 4), (1, 7), (2, 10)]


class TestMaps:
    def test_highest_degrees(self) -> None:
        angles = np.deg2rad(np.arange(72) * 5.0)
        curves = [4.0 * np.cos(angles - np.deg2rad(degrees)) for degrees in (0.0, 123.4, 358.9)]
        found = highest_degrees(np.array([*curves, np.zeros(72)]))
        assert_allclose(found[:3], [0.0, 123.4, 358.9], atol=0.02)
        assert np.isnan(found[3])

    def test_packing_keeps_what_is_said(self) -> None:
        block = belief()[0]
        facts = CellFacts()
        touched = np.array([7, 8, 16])
        density = np.zeros((3, 2, 4), dtype=np.float32)
        density[0, 0, 1] = density[1, 1, 3] = density[2, 0, 2] = 9.0
        facts.add(
            replace(
                block,
                cells=touched,
                log_density=density,
                log_time_ns=STAMP_NS,
                measurements=np.array([4, 5, 6]),
            )
        )
        packed = pack_maps([maps()], facts)
        # Cells 7, 8 and 16 are in rows 1, 1, 2 and columns 1, 2, 4 of a grid with 6 columns.
        assert (packed["first_row"], packed["first_column"]) == (1, 1)
        assert (packed["rows"], packed["columns"]) == (2, 4)
        assert packed["origin"] == [-0.5, 2.5]
        assert packed["prior"] == [0.5, 0.25, 0.25]
        (planes,) = unpacked(packed, 2)
        n = NOTHING
        assert_array_equal(planes[0], [[7000, 5000, n, n], [n, n, n, 1000]])
        assert_array_equal(planes[2], [[1000, 1000, n, n], [n, n, n, 9000]])
        assert_array_equal(planes[3], [[90, n, n, n], [n, n, n, 180]])
        assert_array_equal(planes[4], [[n, 270, n, n], [n, n, n, n]])
        assert_array_equal(planes[5], [[4, 5, n, n], [n, n, n, 6]])

    def test_too_many_maps_are_thinned_and_the_last_is_kept(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        rng = np.random.default_rng(3)
        grid = Grid((0.0, 0.0), 0.1, 30, 30)
        noisy = [noise(rng, grid, index) for index in range(8)]
        one = len(pack_maps(noisy[:1], CellFacts())["data"])
        monkeypatch.setattr(report_maps, "MOST_BYTES", 5 * one)
        packed = pack_maps(noisy, CellFacts())
        assert packed["stored"] == 8
        assert packed["stamps_ns"] == [str(STAMP_NS + index) for index in (1, 3, 5, 7)]
        assert_array_equal(
            unpacked(packed, 2)[-1, :3].reshape(3, -1),
            np.rint(1e4 * noisy[7].class_probabilities.T),
        )
        monkeypatch.setattr(report_maps, "MOST_BYTES", 1)
        assert pack_maps(noisy, CellFacts())["stamps_ns"] == [str(STAMP_NS + 7)]


def noise(rng: np.random.Generator, grid: Grid, index: int) -> ClassMaps:
    """A map that cannot be compressed."""
    cells = np.arange(grid.rows * grid.columns)
    return ClassMaps(
        grid=grid,
        stamp_ns=STAMP_NS + index,
        log_time_ns=STAMP_NS + index,
        cells=cells,
        class_probabilities=rng.dirichlet([1.0, 1.0, 1.0], len(cells)),
        untouched=np.array([0.5, 0.25, 0.25]),
    )


def write_output(
    path: Path,
    *,
    names: tuple[str, ...] = CLASS_NAMES,
    object_ids: tuple[str, ...] = ("a", "b"),
    count: int = 4,
    all_maps: Sequence[ClassMaps] = (),
    blocks: Sequence[BeliefBlock] = (),
    hostile: str = "",
) -> None:
    """An output with so many measurements, each of which moves its object's belief."""
    found = many(count, object_ids)
    found = replace(found, label_names=(hostile or "books",))
    weights = np.random.default_rng(1).dirichlet(np.ones(len(names) + 1), count)
    with LogWriter(path, profile="ros2") as writer:
        channels = OutputChannels(writer, "ros2", hostile or "odom", model(names))
        channels.write_measurements(found)
        latest = {}
        for row in range(count):
            name = object_ids[row % len(object_ids)]
            stamp = int(found.stamps_ns[row])
            latest[name] = estimate(
                name,
                probabilities=tuple(weights[row].tolist()),
                measurements=row // len(object_ids) + 1,
                stamp_ns=stamp,
            )
            channels.write_objects(list(latest.values()), stamp, stamp)
        for block in blocks:
            channels.write_belief(block)
        for written in all_maps:
            channels.write_maps(written)
        account = {"used": count, "skipped": {hostile or "x": 2}, "notes": [hostile]}
        channels.write_header(
            STAMP_NS, input_hash=hostile, settings={"input": hostile}, account=account
        )


class TestPage:
    def test_default_name_and_what_is_printed(self, lab: Path) -> None:
        done = mclass("report", lab)
        page = lab.with_suffix(".html")
        assert done.stdout.startswith(f"{page}: 3 objects, 5 measurements, ")
        assert document_in(page) == document_of(lab)
        assert sorted(path.name for path in lab.parent.iterdir()) == [page.name, lab.name]

    def test_same_output_same_bytes(self, lab: Path, tmp_path: Path) -> None:
        pages = [tmp_path / "a.html", tmp_path / "b.html"]
        for page in pages:
            mclass("report", lab, "-o", page)
        assert pages[0].read_bytes() == pages[1].read_bytes()

    def test_an_existing_page_stays_unless_told(self, lab: Path, tmp_path: Path) -> None:
        page = tmp_path / "page.html"
        page.write_text("mine")
        assert "--overwrite" in mclass("report", lab, "-o", page, code=1).stderr
        assert page.read_text() == "mine"
        mclass("report", lab, "-o", page, "--overwrite")
        assert document_in(page)["file"] == lab.name
        assert [path.name for path in tmp_path.iterdir()] == ["page.html"]

    def test_the_output_itself_is_never_replaced(self, lab: Path) -> None:
        before = lab.read_bytes()
        assert "input itself" in mclass("report", lab, "-o", lab, "--overwrite", code=1).stderr
        assert lab.read_bytes() == before

    def test_a_log_without_results_is_refused(self, tmp_path: Path) -> None:
        done = mclass("report", SAMPLES / "cas_lab.mcap", "-o", tmp_path / "a.html", code=1)
        assert "mclass estimate" in done.stderr
        assert list(tmp_path.iterdir()) == []

    def test_a_damaged_output_is_shown_as_far_as_it_can_be(self, lab: Path, tmp_path: Path) -> None:
        data = bytearray(lab.read_bytes())
        # In the odometry, of which the results need nothing more.
        data[20_000:20_050] = bytes(50)
        (tmp_path / "out.mcap").write_bytes(data)
        done = mclass("report", tmp_path / "out.mcap", code=3)
        assert "damaged: " in done.stderr
        document = document_in(tmp_path / "out.html")
        assert document["facts"]["damage"][0] in done.stderr
        assert len(document["objects"]) == 3

    def test_needs_nothing_else(self, lab: Path, tmp_path: Path) -> None:
        mclass("report", lab, "-o", tmp_path / "page.html")
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        head = text.partition("</head>")[0]
        policy = re.search(r'Security-Policy" content="([^"]*)"', head)
        assert policy is not None
        assert policy[1].startswith("default-src 'none'; script-src 'sha256-")
        assert "unsafe" not in policy[1]
        code = re.sub(r'id="document">.*', "", text)
        assert (
            re.findall(r"(?:https?:)?//[a-z]", code.replace("http://www.w3.org/2000/svg", "")) == []
        )
        assert not re.search(r"\b(?:src|href)=|@import|url\(|innerHTML|eval\(|fetch\(", code)

    def test_foreign_text_is_data_alone(self, tmp_path: Path) -> None:
        path = tmp_path / "out.mcap"
        write_output(path, names=(HOSTILE, "b"), object_ids=(HOSTILE, "o"), hostile=HOSTILE)
        mclass("report", path)
        text = (tmp_path / "out.html").read_text(encoding="utf-8")
        assert "onerror" in text
        assert "<img" not in text
        assert text.count("</script>") == 2
        document = document_in(tmp_path / "out.html")
        assert document["objects"][0]["name"] == HOSTILE
        assert document["classes"][0]["name"] == HOSTILE
        assert document["frame"] == HOSTILE
        assert [HOSTILE, 2] in document["facts"]["skipped"]

    def test_an_id_of_a_megabyte_is_cut(self, tmp_path: Path) -> None:
        path = tmp_path / "out.mcap"
        write_output(path, object_ids=("x" * 10**6, "o"))
        mclass("report", path)
        assert (tmp_path / "out.html").stat().st_size < 200_000

    def test_200_by_200_cells_and_500_measurements_stay_below_5_mb(self, tmp_path: Path) -> None:
        rng = np.random.default_rng(4)
        grid = Grid((0.0, 0.0), 0.1, 200, 200)
        noisy = [noise(rng, grid, index * 10**9) for index in range(12)]
        blocks = [turned(rng, found) for found in noisy]
        path = tmp_path / "out.mcap"
        write_output(path, count=500, all_maps=noisy, blocks=blocks)
        mclass("report", path)
        page = tmp_path / "out.html"
        assert 1_000_000 < page.stat().st_size < 5_000_000
        document = document_in(page)
        assert len(document["steps"]["seconds"]) == 500
        assert sum(len(entry["updates"]) for entry in document["objects"]) == 500
        assert document["map"]["stored"] == 12
        last = unpacked(document["map"], 2)[-1, :3].reshape(3, -1)
        assert_array_equal(last, np.rint(1e4 * as_written(noisy[-1])).T)

    @pytest.mark.parametrize("text", ["</script>", "<!--<script>", "\u2028&lt;", "\ud800"])
    def test_json_data_begins_no_tag(self, text: str) -> None:
        data = json_data({"a": text})
        assert not set(data) & set("<>&")
        assert data.isascii()
        assert json.loads(data) == {"a": text}

    def test_every_file_of_the_template_is_used_and_of_sensible_size(self) -> None:
        used = {"page.html", "style.css", *(f"{name}.js" for name in SCRIPTS)}
        assert {path.name for path in WEB.iterdir()} == used
        for path in WEB.iterdir():
            assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, path.name


def turned(rng: np.random.Generator, found: ClassMaps) -> BeliefBlock:
    """The belief beside a map: every cell faces anywhere."""
    count = len(found.cells)
    return BeliefBlock(
        object_id="",
        grid=found.grid,
        stamp_ns=found.stamp_ns,
        log_time_ns=found.log_time_ns,
        block=0,
        blocks=1,
        cells=found.cells,
        log_cell_mass=np.zeros(count),
        log_class_probability=np.log(found.class_probabilities),
        log_density=rng.normal(size=(count, 2, 8)).astype(np.float32),
        measurements=rng.integers(0, 500, count),
    )


def as_written(found: ClassMaps) -> FloatArray:
    """Probabilities as an output keeps them: float32, normalised again."""
    single = found.class_probabilities.astype(np.float32).astype(np.float64)
    return np.asarray(single / single.sum(axis=1, keepdims=True))
