"""Figures: what is drawn is what was given, and every picture says what it shows."""

from __future__ import annotations

import builtins
import importlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from lopsided_results import CLASS_NAMES, cell, estimate, maps, mode
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from models import lopsided_model, measurements_of

from mclass.classes import ClassModel
from mclass.errors import MclassError, UsageError
from mclass.outputs.colors import class_color
from mclass.plot import (
    cell_figure,
    figure_format,
    likelihood_figure,
    map_figure,
    objects_figure,
    orientation_figure,
    ray_segments,
    save_figure,
)
from mclass.plot.labels import place_texts, text_size
from mclass.plot.style import CLASS_MARKERS, drawable
from mclass.records import PoseTrack
from mclass.results import ClassMaps


def panel(figure: Figure, title: str) -> Axes:
    """The axes with a title."""
    found = [
        a
        for a in figure.axes
        if title in (a.get_title(), a.get_title(loc="left"), a.get_title(loc="left").split(",")[0])
    ]
    assert len(found) == 1, [a.get_title() or a.get_title(loc="left") for a in figure.axes]
    return found[0]


def texts(figure: Figure) -> list[str]:
    """Every text in a figure, drawn first so that tick labels are in place."""
    figure.draw_without_rendering()
    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


def legend_names(owner: Axes | Figure) -> list[str]:
    legend = owner.legends[0] if isinstance(owner, Figure) else owner.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def scale_bar(axes: Axes) -> tuple[float, str]:
    """Its length in data units and its text."""
    (line,) = [line for line in axes.lines if line.get_gid() == "scale bar"]
    x = np.asarray(line.get_xdata())
    (text,) = [t.get_text() for t in axes.texts if t.get_text() and t.xy[0] == x.mean()]  # type: ignore[attr-defined]
    return round(float(x[1] - x[0]), 9), text


def one_panel(field_labels: Sequence[str] = ("a",)) -> ClassModel:
    """A model of the lopsided one's first class and label alone."""
    model = lopsided_model()
    return ClassModel(
        class_names=("one",),
        label_names=tuple(field_labels),
        log_priors=np.log([0.5, 0.5]),
        background_log_likelihood=np.zeros(len(field_labels)),
        likelihoods={(0, 0): model.likelihoods[0, 0]},
    )


class TestLikelihoodFigure:
    def test_the_field_is_the_models(self) -> None:
        model = lopsided_model()
        figure = likelihood_figure(model, half_width=2.5)
        axes = panel(figure, "label b\nof class two")
        (image,) = axes.get_images()
        values = np.asarray(image.get_array())
        # Columns grow with x, rows with y; 201 points, 0.025 m apart.
        assert image.origin == "lower"
        for x, y in [(-1.4, 0.3), (0.2, -1.3), (1.0, 2.0)]:
            row, column = round((y + 2.5) / 0.025), round((x + 2.5) / 0.025)
            expected = np.exp(model.likelihoods[1, 1].log_likelihood(np.array([x, y])))
            assert values[row, column] == pytest.approx(expected)
        assert image.get_extent() == pytest.approx((-2.5125, 2.5125, -2.5125, 2.5125))
        assert axes.get_xlim() == (-2.5, 2.5)
        assert axes.get_aspect() == 1.0

    def test_rows_are_classes_and_columns_labels(self) -> None:
        figure = likelihood_figure(lopsided_model())
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert titles == [
            f"label {label}\nof class {name}" for name in ("one", "two", "three") for label in "ab"
        ]

    def test_one_scale_and_units(self) -> None:
        figure = likelihood_figure(lopsided_model())
        limits = {image.get_clim() for axes in figure.axes for image in axes.get_images()}
        assert len(limits) == 1
        assert limits.pop()[0] == 0.0
        words = texts(figure)
        assert {"x [m]", "y [m]", "likelihood [1/(m² rad)]"} <= set(words)
        assert any("at bearing 0" in word for word in words)

    def test_another_length_unit(self) -> None:
        in_metres = likelihood_figure(one_panel(), half_width=2.0)
        in_decimetres = likelihood_figure(one_panel(), half_width=2.0, unit=("dm", 0.1))
        first, second = (
            np.asarray(figure.axes[0].get_images()[0].get_array())
            for figure in (in_metres, in_decimetres)
        )
        np.testing.assert_allclose(second, first / 100.0)
        assert in_decimetres.axes[0].get_xlim() == pytest.approx((-20.0, 20.0))
        assert {"x [dm]", "likelihood [1/dm²]"} <= set(texts(in_decimetres))
        assert scale_bar(in_decimetres.axes[0]) == (10.0, "10 dm")

    def test_impossible_pairs_are_said(self) -> None:
        axes = panel(likelihood_figure(lopsided_model()), "label a\nof class three")
        assert not axes.get_images()
        assert "never returned" in [text.get_text() for text in axes.texts]

    def test_around_an_object_that_stands_somewhere(self) -> None:
        # Facing 90 degrees at (3, -1): the sensor's (0.3, 1.4) in the object's frame is
        # (3 - 1.4, -1 + 0.3) in the world.
        model = lopsided_model()
        figure = likelihood_figure(model, half_width=2.5, pose=(3.0, -1.0, np.pi / 2.0))
        axes = panel(figure, "label b\nof class two")
        (image,) = axes.get_images()
        assert axes.get_xlim() == pytest.approx((0.5, 5.5))
        assert axes.get_ylim() == pytest.approx((-3.5, 1.5))
        column, row = round((1.6 - 0.5) / 0.025), round((-0.7 + 3.5) / 0.025)
        expected = np.exp(model.likelihoods[1, 1].log_likelihood(np.array([0.3, 1.4])))
        assert np.asarray(image.get_array())[row, column] == pytest.approx(expected)
        crosses = np.asarray(next(x for x in axes.lines if x.get_marker() == "+").get_xydata())
        x, y = model.likelihoods[1, 1].mixture.means[0]
        np.testing.assert_allclose(crosses[0], [3.0 - y, -1.0 + x])

    def test_chosen_pairs(self) -> None:
        figure = likelihood_figure(lopsided_model(), pairs=[(2, 1), (0, 0)])
        titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
        assert titles == ["label b\nof class three", "label a\nof class one"]

    def test_everything_lies_inside(self) -> None:
        # The furthest reach of any viewpoint: y = 1.3 + 3 sqrt(0.4), by hand.
        axes = likelihood_figure(lopsided_model()).axes[0]
        assert axes.get_ylim()[1] == pytest.approx(1.3 + 3.0 * np.sqrt(0.4))

    def test_many_labels_leave_out_the_impossible(self) -> None:
        figure = likelihood_figure(one_panel([f"label_{k}" for k in range(65)]))
        assert [a.get_title() for a in figure.axes if a.get_title()] == [
            "label label_0\nof class one"
        ]

    def test_too_many_panels(self) -> None:
        with pytest.raises(UsageError, match="65 were asked"):
            likelihood_figure(lopsided_model(), pairs=[(0, 0)] * 65)
        with pytest.raises(UsageError, match="0 were asked"):
            likelihood_figure(lopsided_model(), pairs=[])


class TestOrientationFigure:
    def test_curves_are_the_joint_densities(self) -> None:
        report = cell()
        figure = orientation_figure([report], CLASS_NAMES)
        (axes,) = figure.axes
        # Eight bins, closed at 360: P(books) is 0.75.
        curves = {tuple(np.asarray(line.get_ydata())): line for line in axes.lines}
        expected = 0.75 * np.append(report.density[0], report.density[0, 0])
        (line,) = [line for ys, line in curves.items() if ys == pytest.approx(tuple(expected))]
        assert np.asarray(line.get_xdata()) == pytest.approx(np.arange(0.0, 361.0, 45.0))
        assert axes.get_xlim() == (0.0, 360.0)
        assert axes.get_ylim()[0] == 0.0
        assert axes.get_ylim()[1] > expected.max()

    def test_legend_and_title_tell_all(self) -> None:
        figure = orientation_figure([cell()], ("_hidden", "$a$"), "object $b$")
        (axes,) = figure.axes
        assert legend_names(axes) == ["0.1250  background", "0.7500  _hidden", "0.1250  \\$a\\$"]
        assert axes.get_title(loc="left") == "3: books, parts"
        assert "90.0°" in [text.get_text() for text in axes.texts]
        words = texts(figure)
        assert {"orientation [deg]", "density [1/rad]"} <= set(words)
        assert any(word.startswith("object \\$b\\$\n") for word in words)

    def test_the_prior_is_only_what_was_before(self) -> None:
        prior = cell(measurements=0, probabilities=(0.5, 0.25, 0.25), labels=())
        steps = [prior, cell(measurements=1), cell(measurements=2, labels=("parts",))]
        figure = orientation_figure(steps, CLASS_NAMES)
        assert [a.get_title(loc="left") for a in figure.axes] == ["1: books, parts", "2: parts"]
        faint = [line for line in figure.axes[0].lines if line.get_alpha() is not None]
        peaks = sorted(float(np.max(np.asarray(line.get_ydata()))) for line in faint)
        assert peaks == pytest.approx(
            sorted([0.25 * prior.density[0].max(), 0.25 * prior.density[1].max()])
        )

    def test_a_lone_prior_has_a_panel(self) -> None:
        figure = orientation_figure([cell(measurements=0, labels=())], CLASS_NAMES)
        assert figure.axes[0].get_title(loc="left") == "prior"

    def test_a_long_history_keeps_first_and_last(self) -> None:
        steps = [cell(measurements=k) for k in range(1, 101)]
        figure = orientation_figure(steps, CLASS_NAMES)
        numbers = [int(a.get_title(loc="left").split(":")[0]) for a in figure.axes]
        assert len(numbers) == 8
        assert numbers == sorted(numbers)
        assert (numbers[0], numbers[-1]) == (1, 100)

    def test_no_history(self) -> None:
        assert "no measurement" in texts(orientation_figure([], CLASS_NAMES))


class TestCellFigure:
    def test_bars_and_rose(self) -> None:
        report = cell()
        figure = cell_figure(report, CLASS_NAMES, "odom", object_id="o7")
        bars, rose = figure.axes
        assert [bar.get_width() for bar in bars.patches] == [0.125, 0.75, 0.125]  # type: ignore[attr-defined]
        figure.draw_without_rendering()
        assert [t.get_text() for t in bars.get_yticklabels()] == ["background", "books", "parts"]
        # The rose closes where it began, and its peak is at 90 degrees.
        line = rose.lines[0]
        angles, density = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        assert density[0] == density[-1]
        assert np.rad2deg(angles[density.argmax()]) == pytest.approx(90.0)
        assert "object o7, cell (2.75, 3.75) m in odom, 3 measurements" in texts(figure)

    def test_classes_not_drawn_are_summed_up(self) -> None:
        count = 9
        report = cell(
            density=np.full((count, 8), 0.5 / np.pi),
            probabilities=(0.1, *([0.05] * 3), *([0.125] * 6)),
            modes=((),) * count,
        )
        figure = cell_figure(report, [f"c{k}" for k in range(count)], "odom")
        bars = figure.axes[0]
        figure.draw_without_rendering()
        assert bars.get_yticklabels()[-1].get_text() == "3 others"
        assert bars.patches[-1].get_width() == pytest.approx(0.15)  # type: ignore[attr-defined]


class TestMapFigure:
    def test_row_zero_is_at_the_bottom(self) -> None:
        figure = map_figure(maps(), CLASS_NAMES, "odom")
        axes = panel(figure, "P(parts)")
        (image,) = axes.get_images()
        values = np.ma.filled(np.ma.masked_invalid(np.asarray(image.get_array(), float)), -1.0)
        # Cells 7, 8 are row 1, columns 1 and 2; cell 16 is row 2, column 4.
        np.testing.assert_allclose(values, [[0.1, 0.1, -1.0, -1.0], [-1.0, -1.0, -1.0, 0.9]])
        assert image.origin == "lower"
        assert image.get_extent() == pytest.approx((-0.5, 1.5, 2.5, 3.5))
        assert image.get_clim() == (0.0, 1.0)
        assert axes.get_aspect() == 1.0

    def test_black_is_certain_and_untouched_is_tinted(self) -> None:
        (image,) = panel(map_figure(maps(), CLASS_NAMES, "odom"), "P(books)").get_images()
        assert image.to_rgba(np.array([1.0]))[0, :3] == pytest.approx([0.0, 0.0, 0.0])
        assert image.to_rgba(np.array([0.0]))[0, :3] == pytest.approx([1.0, 1.0, 1.0])
        bad = np.asarray(image.get_cmap().get_bad())
        assert bad[0] > bad[2] + 0.2

    def test_a_panel_a_class(self) -> None:
        figure = map_figure(maps(), CLASS_NAMES, "odom")
        titles = [a.get_title(loc="left") for a in figure.axes if a.get_title(loc="left")]
        assert titles == [
            "P(background), prior 0.5000",
            "P(books), prior 0.2500",
            "P(parts), prior 0.2500",
        ]
        words = texts(figure)
        assert {"x [m]", "y [m]", "probability", "Class probabilities in odom"} <= set(words)
        assert legend_names(figure) == ["not seen: prior"]

    def test_everything_drawn_is_inside(self) -> None:
        track = PoseTrack("odom", "base", np.array([1, 2]), np.array([[-7.0, 0, 0], [1, 9.0, 1]]))
        rays = np.array([[[0.0, -3.0], [1.0, 1.0]]])
        objects = [estimate(position=(12.0, 1.0))]
        figure = map_figure(maps(), CLASS_NAMES, "odom", objects=objects, track=track, rays=rays)
        axes = panel(figure, "P(background)")
        assert axes.get_xlim()[0] < -7.0
        assert axes.get_xlim()[1] > 12.0
        assert axes.get_ylim()[0] < -3.0
        assert axes.get_ylim()[1] > 9.0
        (collection,) = [c for c in axes.collections if isinstance(c, LineCollection)]
        np.testing.assert_allclose(collection.get_segments()[0], rays[0])
        tracks = [np.asarray(line.get_xydata()) for line in axes.lines]
        assert any(np.array_equal(xy, [[-7.0, 0.0], [1.0, 9.0]]) for xy in tracks)
        assert "o1" in [text.get_text() for text in axes.texts]
        assert len(legend_names(figure)) == 4

    def test_nothing_touched(self) -> None:
        empty = ClassMaps(
            grid=maps().grid,
            stamp_ns=0,
            log_time_ns=0,
            cells=np.zeros(0, dtype=np.int64),
            class_probabilities=np.zeros((0, 3)),
            untouched=np.array([0.5, 0.25, 0.25]),
        )
        axes = panel(map_figure(empty, CLASS_NAMES, "odom"), "P(books)")
        assert np.isnan(np.asarray(axes.get_images()[0].get_array(), float)).all()
        assert axes.get_xlim()[1] > 2.0

    def test_of_many_classes_the_probable_are_drawn(self) -> None:
        probabilities = np.full((3, 41), 0.01)
        probabilities[1, 33] = 0.6
        crowded = ClassMaps(maps().grid, 0, 0, maps().cells, probabilities, np.full(41, 1.0 / 41.0))
        figure = map_figure(crowded, [f"c{k}" for k in range(1, 41)], "odom")
        titles = [a.get_title(loc="left") for a in figure.axes if a.get_title(loc="left")]
        assert len(titles) == 12
        assert titles[0].startswith("P(background),")
        assert any(title.startswith("P(c33),") for title in titles)

    def test_scale_bar(self) -> None:
        axes = panel(map_figure(maps(), CLASS_NAMES, "odom"), "P(books)")
        # 2.16 m wide: a quarter is 0.54, the round length below it 0.5.
        assert scale_bar(axes) == (0.5, "0.5 m")


class TestRaySegments:
    def test_boxes_have_two_edges_and_rays_one(self) -> None:
        measurements = measurements_of(
            [[1.0, 2.0, 0.0], [3.0, -1.0, 0.0], [0.0, 0.0, 0.0]],
            [[0], [1], [0]],
            [[0.0, np.pi / 2], [np.pi, np.pi], [np.nan, np.nan]],
        )
        segments = ray_segments(measurements, 2.0)
        expected = [
            [[1.0, 2.0], [3.0, 2.0]],
            [[3.0, -1.0], [1.0, -1.0]],
            [[1.0, 2.0], [1.0, 4.0]],
        ]
        np.testing.assert_allclose(segments, expected, atol=1e-12)

    def test_a_box_as_a_ray_is_its_middle(self) -> None:
        # From 170 to -150 degrees, across the turn: the middle is -170.
        edges = [[np.deg2rad(170.0), np.deg2rad(-150.0)]]
        measurements = measurements_of([[1.0, 2.0, 0.0]], [[0]], edges)
        segments = ray_segments(measurements, 2.0, "ray")
        end = [1.0 + 2.0 * np.cos(np.deg2rad(190.0)), 2.0 + 2.0 * np.sin(np.deg2rad(190.0))]
        np.testing.assert_allclose(segments, [[[1.0, 2.0], end]])

    def test_of_many_some(self) -> None:
        count = 1000
        poses = [[float(k), 0.0, 0.0] for k in range(count)]
        measurements = measurements_of(poses, [[0]] * count, np.zeros((count, 2)))
        segments = ray_segments(measurements, 1.0, most=10)
        assert segments.shape == (10, 2, 2)
        assert (segments[0, 0, 0], segments[-1, 0, 0]) == (0.0, 999.0)


class TestObjectsFigure:
    def test_place_spread_and_facing(self) -> None:
        one = estimate(position=(4.0, -2.5), position_std=(0.05, 0.2), modes=(mode(90.0, 1.0, 5),))
        figure = objects_figure([one], CLASS_NAMES, "map")
        axes = figure.axes[0]
        (ellipse,) = [patch for patch in axes.patches if isinstance(patch, Ellipse)]
        assert ellipse.get_center() == pytest.approx((4.0, -2.5))
        assert (ellipse.get_width(), ellipse.get_height()) == pytest.approx((0.2, 0.8))
        arrows = [text for text in axes.texts if getattr(text, "arrow_patch", None) is not None]
        (arrow,) = arrows
        tip, tail = np.array(arrow.xy), np.array(arrow.xyann)  # type: ignore[attr-defined]
        np.testing.assert_allclose(tail, [4.0, -2.5])
        assert tip[0] == pytest.approx(4.0)
        assert tip[1] > -2.5
        assert "o1\nbooks 0.8494" in [text.get_text() for text in axes.texts]
        assert legend_names(figure) == ["books"]

    def test_arrows_are_as_opaque_as_their_mode_is_heavy(self) -> None:
        figure = objects_figure([estimate()], CLASS_NAMES, "map")
        patches = [getattr(text, "arrow_patch", None) for text in figure.axes[0].texts]
        assert [patch.get_alpha() for patch in patches if patch] == [0.75, 0.25]

    def test_a_known_position_has_no_ellipse(self) -> None:
        figure = objects_figure([estimate(position_std=(0.0, 0.0))], CLASS_NAMES, "map")
        assert not figure.axes[0].patches

    def test_a_tie_is_said(self) -> None:
        tied = estimate(probabilities=(0.5, 0.25, 0.25), tie=(0, 1))
        figure = objects_figure([tied], CLASS_NAMES, "map")
        assert "o1\ntie: books 0.2500" in [text.get_text() for text in figure.axes[0].texts]

    def test_a_crowd_is_drawn_smaller(self) -> None:
        few = [estimate(f"o{k}", position=(float(k), 0.0)) for k in range(12)]
        many = [estimate(f"o{k}", position=(k / 4.0, 0.0)) for k in range(48)]
        sizes = []
        for objects in (few, many):
            axes = objects_figure(objects, CLASS_NAMES, "map").axes[0]
            sizes.append([line.get_markersize() for line in axes.lines if line.get_marker() == "o"])
            assert len(sizes[-1]) == len(objects)
        assert sizes[1][0] == pytest.approx(sizes[0][0] / 2.0)

    def test_no_objects(self) -> None:
        assert "no objects" in texts(objects_figure([], CLASS_NAMES, "map"))


class TestSaving:
    @pytest.mark.parametrize(
        ("suffix", "magic"),
        [(".png", b"\x89PNG\r\n\x1a\n"), (".svg", b"<?xml"), (".pdf", b"%PDF"), (".PNG", b"\x89P")],
    )
    def test_by_suffix_and_byte_for_byte(self, tmp_path: Path, suffix: str, magic: bytes) -> None:
        contents = []
        for name in ("first", "second"):
            path = tmp_path / f"{name}{suffix}"
            save_figure(objects_figure([estimate()], CLASS_NAMES, "odom"), path)
            contents.append(path.read_bytes())
        assert contents[0].startswith(magic)
        assert contents[0] == contents[1]
        assert len(list(tmp_path.iterdir())) == 2

    def test_an_old_file_is_replaced(self, tmp_path: Path) -> None:
        path = tmp_path / "map.svg"
        path.write_text("old")
        save_figure(map_figure(maps(), CLASS_NAMES, "odom"), path)
        assert path.read_text().startswith("<?xml")

    @pytest.mark.parametrize("name", ["figure.jpg", "figure", "log.mcap", ".png"])
    def test_another_suffix_is_refused(self, tmp_path: Path, name: str) -> None:
        with pytest.raises(UsageError, match=r"\.png, \.svg or \.pdf"):
            save_figure(Figure(), tmp_path / name)
        assert not list(tmp_path.iterdir())

    def test_format(self) -> None:
        assert figure_format("a/b.c.SVG") == "svg"

    def test_a_missing_folder_is_said(self, tmp_path: Path) -> None:
        with pytest.raises(MclassError, match=r"nowhere/f\.png: cannot be written"):
            save_figure(Figure(), tmp_path / "nowhere" / "f.png")

    def test_user_settings_neither_matter_nor_change(self, tmp_path: Path) -> None:
        save_figure(cell_figure(cell(), CLASS_NAMES, "odom"), tmp_path / "plain.svg")
        with matplotlib.rc_context(
            {"font.size": 30.0, "lines.linewidth": 9.0, "svg.hashsalt": "other"}
        ):
            save_figure(cell_figure(cell(), CLASS_NAMES, "odom"), tmp_path / "styled.svg")
            assert matplotlib.rcParams["font.size"] == 30.0
        assert (tmp_path / "plain.svg").read_bytes() == (tmp_path / "styled.svg").read_bytes()

    def test_pyplot_stays_out(self) -> None:
        # In a process of its own: here another test may have imported it.
        program = "import mclass.plot, sys; sys.exit('matplotlib.pyplot' in sys.modules)"
        subprocess.run([sys.executable, "-c", program], check=True)


class TestForeignNames:
    def test_drawable(self) -> None:
        assert drawable("a$b$") == r"a\$b\$"
        assert drawable("x\x1b\n") == r"x\x1b\n"
        assert drawable("größe") == "größe"
        assert drawable("\u672c") == r"\u672c"
        assert len(drawable("x" * 10**6, 20)) == 20

    @pytest.mark.parametrize("name", ["$\\frac$", "_x", "", "\x00本%\\" * 90])
    def test_no_name_spoils_a_figure(self, tmp_path: Path, name: str) -> None:
        names = (name, "b")
        one = estimate(name)
        figures = [
            objects_figure([one], names, name),
            cell_figure(cell(labels=(name,)), names, name, object_id=name),
            orientation_figure([cell(labels=(name,))], names, name),
            map_figure(maps(), names, name, objects=[one]),
        ]
        for index, figure in enumerate(figures):
            save_figure(figure, tmp_path / f"{index}.png")


def test_without_matplotlib_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("mclass.plot")]:
        monkeypatch.delitem(sys.modules, name)
    importing = builtins.__import__

    def without_matplotlib(
        name: str,
        globals: Mapping[str, Any] | None = None,  # noqa: A002
        locals: Mapping[str, Any] | None = None,  # noqa: A002
        fromlist: Sequence[str] | None = (),
        level: int = 0,
    ) -> Any:
        if name.split(".", maxsplit=1)[0] == "matplotlib":
            raise ImportError("No module named 'matplotlib'")
        return importing(name, globals, locals, fromlist or (), level)

    monkeypatch.setattr(builtins, "__import__", without_matplotlib)
    with pytest.raises(UsageError, match=r"pip install 'mclass\[plot\]'"):
        importlib.import_module("mclass.plot")


class TestTextPlaces:
    def test_each_goes_where_nothing_is(self) -> None:
        # The arrow of the first lies to the upper right, the border to the left.
        corners = place_texts(
            np.array([[5.0, 50.0]]), [(30.0, 10.0)], np.array([[20.0, 60.0]]), (200.0, 100.0), 4.0
        )
        np.testing.assert_allclose(corners, [[4.0, -14.0]])

    def test_texts_of_neighbours_do_not_overlap(self) -> None:
        anchors = np.array([[100.0, 50.0], [104.0, 50.0], [100.0, 54.0], [104.0, 54.0]])
        sizes = [(40.0, 10.0)] * 4
        low = anchors + place_texts(anchors, sizes, np.empty((0, 2)), (200.0, 100.0), 4.0)
        high = low + sizes
        for i in range(4):
            for j in range(i):
                apart = (low[i] >= high[j]) | (low[j] >= high[i])
                assert apart.any(), (i, j)
            assert not ((anchors > low[i]) & (anchors < high[i])).all(axis=1).any()

    def test_a_text_is_as_wide_as_its_longest_line(self) -> None:
        assert text_size("ab\nabcd", 10.0) == pytest.approx((24.0, 25.0))


class TestImprobableClasses:
    def test_they_are_not_drawn(self) -> None:
        report = cell(
            density=np.full((3, 8), 0.5 / np.pi),
            probabilities=(0.4, 0.6, 0.0, 0.0),
            modes=((),) * 3,
        )
        axes = orientation_figure([report], ("a", "b", "c")).axes[0]
        assert legend_names(axes) == ["0.4000  background", "0.6000  a", "2 more not drawn"]

    def test_one_that_was_probable_is(self) -> None:
        before = cell(measurements=1, probabilities=(0.2, 0.5, 0.3))
        after = cell(measurements=2, probabilities=(0.2, 0.8, 0.0))
        figure = orientation_figure([before, after], CLASS_NAMES)
        assert legend_names(figure.axes[1])[2] == "0.0000  parts"

    def test_without_any_probable_the_likeliest_is(self) -> None:
        figure = orientation_figure([cell(probabilities=(1.0, 0.0, 0.0))], CLASS_NAMES)
        assert legend_names(figure.axes[0])[1] == "0.0000  books"


def test_markers_and_colours_tell_42_classes_apart() -> None:
    pairs = {(class_color(index), CLASS_MARKERS[index % len(CLASS_MARKERS)]) for index in range(42)}
    assert len(pairs) == 42
