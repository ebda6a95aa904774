"""The picture of a frame's decisions and the report's section on them."""

from __future__ import annotations

import warnings
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kalmap.data import open_audit, write_audit
from kalmap.data.audit import AUDIT
from kalmap.records import SPURIOUS
from kalmap.records.trail import trouble
from kalmap.view import Trail, decision_figure, render_report
from kalmap.view.decision_figure import gate_covariances
from kalmap.view.decision_groups import groups, points_of
from kalmap.view.style import png_bytes
from test_view_samples import loop_run, manifest
from trails import GATE, NEW_GATE, cluster, contest, decide, distance, easy, nothing, replaced, scattered

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def no_warnings():
    """Any warning of numpy or matplotlib is a fault."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def legend(figure) -> set[str]:
    return {text.get_text() for text in figure.legends[0].get_texts()}


def offsets(axes, label) -> np.ndarray:
    return next(one for one in axes.collections if one.get_label() == label).get_offsets()


def test_sightings_stand_where_they_were_seen():
    """Oracle: the points that the frame was made from."""
    points = np.array([[12.0, 4.0], [-3.0, -7.0], [5.0, 5.0]])
    frame = decide(0, {}, points, sensor=(2.0, -1.0, 2.5))
    np.testing.assert_allclose(points_of(frame), points, atol=1e-12)


def test_a_gate_is_where_the_distance_is_the_gate():
    """Oracle: d^2 by the textbook, in range and bearing, at points on the ellipse of a small gate."""
    frame = replaced(contest(), sensor=np.array([1.0, -2.0, 0.4]))
    for place, spread, covariance in zip(
        frame.positions, frame.spreads, gate_covariances(frame), strict=True
    ):
        root = np.linalg.cholesky(covariance)
        for turn in np.linspace(0.0, 6.0, 7):
            gate = 0.01
            point = place + np.sqrt(gate) * root @ (np.cos(turn), np.sin(turn))
            apart = point - frame.sensor[:2]
            value = np.array([np.hypot(*apart), np.arctan2(apart[1], apart[0]) - frame.sensor[2]])
            assert distance(frame.sensor, value, place, spread)[0] == pytest.approx(gate, rel=0.02)


def test_a_gate_has_the_noise_of_the_sighting_nearest_to_it():
    """Oracle: landmark 17 lies straight ahead of a sensor turned to it, so that range noise is noise along the ray."""
    frame = contest()
    heading = float(np.arctan2(4.0, 12.0))
    noises = np.array([np.diag([float(1 + m) ** 2, 1e-12]) for m in range(6)])
    frame = replaced(frame, noises=noises, sensor=np.array([0.0, 0.0, heading]), spreads=np.zeros((5, 2, 2)))
    ray = np.array([np.cos(heading), np.sin(heading)])
    assert ray @ gate_covariances(frame)[0] @ ray == pytest.approx(1.0)  # sighting 0, not the lost sighting 1
    frame = replaced(frame, squared=frame.why.squared * np.where(frame.why.pairs[:, 0] == 1, 1e-3, 1.0))
    assert ray @ gate_covariances(frame)[0] @ ray == pytest.approx(4.0)


def test_without_noises_the_gate_is_the_spread_and_says_so():
    bare = msgspec.structs.replace(contest(), noises=None)
    np.testing.assert_array_equal(gate_covariances(bare), bare.spreads)
    assert f"gate, d² < {GATE:.3g}, sensor noise left out" in legend(decision_figure(bare))
    assert f"gate, d² < {GATE:.3g}" in legend(decision_figure(contest()))


def test_a_contest_shows_all_that_was_decided():
    frame = contest()
    figure = decision_figure(frame)
    whole, *close = figure.axes
    assert len(close) == 3 and whole.get_title(loc="left").startswith(
        "Frame 812, t = 162.4 s: 4 matched, 1 founded, 1 unused\ncase 2"
    )
    assert legend(figure) == {
        "robot, as predicted",
        "field of what was seen",
        "landmark, where it was expected",
        "gate, d² < 9.21",
        f"wide gate, d² < {NEW_GATE:.3g}",
        "sighting, matched",
        "sighting, founds a landmark",
        "sighting, left unused",
        "given to",
        "candidate that was not taken",
    }
    points = points_of(frame)
    np.testing.assert_allclose(offsets(whole, "sighting, left unused"), points[1:2])
    np.testing.assert_allclose(offsets(whole, "sighting, founds a landmark"), points[5:])
    np.testing.assert_allclose(offsets(whole, "sighting, matched"), points[[0, 2, 3, 4]])
    np.testing.assert_allclose(offsets(whole, "landmark, where it was expected"), frame.positions)
    given = {tuple(line.get_xydata().ravel()) for line in whole.lines if line.get_label() == "given to"}
    assert given == {
        (*points[m], *frame.positions[list(frame.landmarks).index(frame.labels[m])]) for m in (0, 2, 3, 4)
    }
    texts = {text.get_text() for text in close[0].texts}
    assert {"17", "s0", "s1", "0.27", "5.36"} <= texts
    assert {"A", "B", "C", "17", "18", "19", "20", "21"} <= {text.get_text() for text in whole.texts}


def test_a_landmark_on_trial_is_told_apart():
    frame = replaced(easy(), trial=np.ones(7, dtype=bool))
    assert "sighting, matched, landmark on trial" in legend(decision_figure(frame))


def test_an_empty_frame_says_so():
    figure = decision_figure(nothing())
    (axes,) = figure.axes
    assert "nothing was seen" in axes.get_title(loc="left")
    assert [text.get_text() for text in axes.texts] == ["no sighting in this frame"]
    assert legend(figure) == {"robot, as predicted"}


@pytest.mark.parametrize("make", [easy, contest, cluster])
def test_no_text_stands_on_another(make):
    """Oracle: matplotlib's own measure of every text; at most a sliver of two boxes may be shared."""
    figure = decision_figure(make())
    figure.draw_without_rendering()
    assert sum(len(axes.texts) for axes in figure.axes) > 15
    for axes in figure.axes:
        boxes = [text.get_window_extent() for text in axes.texts]
        for k, one in enumerate(boxes):
            for other in boxes[:k]:
                across = min(one.x1, other.x1) - max(one.x0, other.x0)
                up = min(one.y1, other.y1) - max(one.y0, other.y0)
                assert min(across, up) < 6.0


def test_groups_are_connected_components_with_the_most_doubtful_first():
    """Oracle: scipy's connected components of the graph of pairs inside the wide gate."""
    rng = np.random.default_rng(2)
    for seed in range(40):
        places = rng.uniform(5.0, 25.0, (12, 2))
        pairs = np.unique(np.column_stack([rng.integers(0, 9, 14), rng.integers(0, 12, 14)]), axis=0)
        frame = replaced(
            decide(seed, scattered(range(12), places), places[:9]),
            pairs=rng.permutation(pairs),
            squared=rng.choice([1.0, GATE + 1.0, NEW_GATE + 1.0], len(pairs)),
            log_volume=np.zeros(len(pairs)),
            labels=np.full(9, SPURIOUS),
        )
        near = frame.why.squared < NEW_GATE
        m, n = frame.why.pairs[near].T
        graph = coo_array((np.ones(near.sum()), (m, 9 + n)), shape=(21, 21))
        _, names = connected_components(graph, directed=False)
        expected = {
            (
                tuple(k for k in range(9) if names[k] == name),
                tuple(k for k in range(12) if names[9 + k] == name),
            )
            for name in np.unique(names[m])
        }
        found = groups(frame)
        assert {(one.sightings, one.landmarks) for one in found} == expected
        counts = [one.doubts for one in found]
        assert counts == sorted(counts, reverse=True) and sum(counts) == trouble(frame).total


def all_in_one_place(count):
    return decide(1, scattered(range(3), [[9, 1], [9, 2], [9, 3]]), np.full((count, 2), (9.0, 1.5)))


@pytest.mark.parametrize(
    "frame",
    [
        replaced(contest(), gate=0.0),
        replaced(contest(), gate=np.inf, new_gate=np.inf),
        replaced(contest(), new_gate=np.nan),
        replaced(contest(), squared=np.full(6, np.nan)),
        replaced(contest(), spreads=np.zeros((5, 2, 2))),
        replaced(contest(), positions=np.full((5, 2), np.nan)),
        replaced(contest(), notes=("a very long story " * 30,)),
        replaced(contest(), sensor=np.array([12.0, 4.0, 0.0])),
        replaced(
            contest(),
            landmarks=np.zeros(0, dtype=int),
            positions=np.zeros((0, 2)),
            spreads=np.zeros((0, 2, 2)),
        ),
        all_in_one_place(2),
        all_in_one_place(200),
        decide(0, {}, np.array([[3.0, 4.0]])),
        decide(0, {}, np.array([[-5.0, 0.1], [-5.0, -0.1]])),
        decide(0, scattered(range(1), [[4.0, 4.0]]), np.array([[1e4, 1e4]])),
    ],
)
def test_every_frame_can_be_drawn(frame):
    """Laid out to the last text, which is where odd numbers would show."""
    assert len(decision_figure(frame).axes) >= 1


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_field_is_the_narrow_sector(side):
    """Two sightings behind the sensor, or ahead of it: on either side of a place where bearings jump."""
    axes = decision_figure(decide(0, {}, np.array([[5.0 * side, 0.1], [5.0 * side, -0.1]]))).axes[0]
    field = next(one for one in axes.patches if one.get_label() == "field of what was seen")
    assert (side * field.get_xy()[:, 0]).min() >= -1e-9


def test_width_is_that_of_every_figure(tmp_path):
    from PIL import Image

    for make in (nothing, cluster):
        content = png_bytes(decision_figure(make()))
        assert content.startswith(PNG)
        (tmp_path / "x.png").write_bytes(content)
        with Image.open(tmp_path / "x.png") as image:
            assert image.width == 1000 and 500 < image.height < 1400


# --- the report ---------------------------------------------------------------------------------------------------


class Words(HTMLParser):
    """A page's words and links."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.words, self.links = "", list[str]()
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name == "href"]

    def handle_data(self, data):
        self.words += data


def trail_of(path, frames, command="kalmap why x") -> Trail:
    write_audit(path / AUDIT, frames, {})
    with open_audit(path) as audit:
        return Trail(audit.summary(), AUDIT, command)


def test_the_report_links_the_trail_and_says_how_to_ask(tmp_path):
    frames = [
        msgspec.structs.replace(easy(), number=7),
        contest(),
        msgspec.structs.replace(cluster(), number=900),
    ]
    html = render_report(
        loop_run(3),
        metrics={},
        manifest=manifest(),
        figures={"association": decision_figure(frames[1])},
        trail=trail_of(tmp_path, frames, "kalmap why 'a result'"),
    )
    page = Words(html)
    assert AUDIT in page.links and "#association" in page.links
    assert "kalmap why 'a result' --frame 900" in page.words
    assert "33 sightings in 3 frames: 24 matched, 2 founded a landmark, 7 left unused." in page.words
    assert "another sighting of the frame has the landmark: left unused7" in page.words
    assert html.index('<section id="association"') < html.index(
        "<img"
    )  # in the section, not among the pictures
    without = render_report(loop_run(3), metrics={}, manifest=manifest(), figures={})
    assert "Association" not in Words(without).words


def test_a_trail_without_doubts_is_reported_too(tmp_path):
    """Also an empty one: no frame to ask about."""
    for frames, words in (([easy()], "--frame 412"), ([], "0 sightings in 0 frames: 0 matched")):
        trail = trail_of(tmp_path, frames)
        page = Words(render_report(loop_run(3), metrics={}, manifest=manifest(), figures={}, trail=trail))
        assert words in page.words and "Frames with the most" not in page.words


def test_names_from_outside_are_escaped(tmp_path):
    trail = msgspec.structs.replace(
        trail_of(tmp_path, [contest()], "kalmap why '<script>'"), file="<script>.sqlite"
    )
    html = render_report(loop_run(3), metrics={}, manifest=manifest(), figures={}, trail=trail)
    assert "<script>" not in html and "&lt;script&gt;" in html
