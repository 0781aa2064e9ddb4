"""The loss of marker recordings: its definition, its frames, and its derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cqrun.engine.model import Records
from cqrun.errors import DataError
from cqrun.measurements.markers import MarkerComparison, Markers
from cqrun.measurements.measurement import Recorded
from cqrun.measurements.placement import Placement
from cqrun.measurements.points import Points
from cqrun.measurements.window import Window

STEP, STEPS, NAMES = 0.02, 30, ("a", "b", "c")


def smooth_record(rng, dim):
    """Return a record of three feet that start at rest and swing."""
    t = STEP * np.arange(STEPS + 1)[:, None, None]
    size = 0.1 * rng.normal(size=(3, dim))
    F = np.eye(dim) + 0.05 * (1 - np.cos(7 * t))[..., None] * rng.normal(size=(3, dim, dim))
    C = 0.35 * np.sin(7 * t)[..., None] * rng.normal(size=(3, dim, dim))
    return Records(0.5 + size * (1 - np.cos(7 * t)), 7 * size * np.sin(7 * t), C, F)


def make(rng, dim=3, *, stems=True, gaps=True, **options):
    """Return a comparison with noise, with gaps, at frames that fall between control steps."""
    time = 0.013 * np.arange(100)
    values = 0.1 * rng.normal(size=(100, 3, dim))
    if gaps:
        values[50:60, 1] = np.nan
        values[:, 2][rng.random(100) < 0.3] = np.nan
    observer = Points(None, 0.1 * rng.normal(size=(3, dim)) if stems else None)
    return compared(observer, time, values, **{"start": 0.3, "start_bounds": (0.25, 0.35), **options})


def compared(observer, time, values, *, control_step=STEP, steps=STEPS, still=None, absolute=False, **window):
    recorded = Recorded("beam.csv", "beam", Window(control_step, steps, **window), lambda: None)
    relative = not absolute
    return MarkerComparison(Markers(), recorded, observer, None, NAMES, time, values, still=still, relative=relative)


def moved(record, direction, h):
    return Records(*(a + h * d for a, d in zip(record, direction, strict=True)))


def richardson(f, h=1e-4):
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("stems", [False, True])
@pytest.mark.parametrize("absolute", [False, True])
def test_residuals_adjoint_by_dot_product(rng, dim, stems, absolute):
    comparison = make(rng, dim, stems=stems, absolute=absolute)
    record, start = (
        smooth_record(rng, dim),
        0.3045,
    )  # no frame near a control step, where the interpolant has a kink in its curvature
    direction = Records(*(rng.normal(size=part.shape) for part in record))
    r_bar = rng.normal(size=comparison.residuals(record, start).shape)
    record_bar, start_bar = comparison.residuals_vjp(record, start, r_bar)

    by_record = richardson(lambda h: r_bar @ comparison.residuals(moved(record, direction, h), start))
    found = sum(np.sum(a * d) for a, d in zip(record_bar, direction, strict=True))
    assert found == pytest.approx(by_record, rel=1e-9)
    by_start = richardson(lambda h: r_bar @ comparison.residuals(record, start + h))
    assert start_bar == pytest.approx(by_start, rel=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_loss_taylor_remainder_of_second_order(rng, dim):
    comparison, record, start = (
        make(rng, dim),
        smooth_record(rng, dim),
        0.3045,
    )  # no frame near a control step, where the interpolant has a kink in its curvature
    direction = Records(*(rng.normal(size=part.shape) for part in record))
    record_bar, start_bar = comparison.loss_vjp(record, start)
    slope = sum(np.sum(a * d) for a, d in zip(record_bar, direction, strict=True)) + start_bar
    base = comparison.loss(record, start)
    steps = np.array([4e-4, 2e-4, 1e-4])
    left = [abs(comparison.loss(moved(record, direction, h), start + h) - base - h * slope) for h in steps]
    assert np.diff(np.log(left)).max() / np.log(0.5) > 1.9


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("absolute", [False, True])
def test_the_adjoint_of_an_offset_by_dot_product(rng, dim, absolute):
    """The loss is quadratic in the offset, so the central difference is exact. Gaps stay gaps."""
    comparison, record = make(rng, dim, absolute=absolute), smooth_record(rng, dim)
    offset, direction = rng.normal(size=(2, dim))
    axes = Placement.none(dim)
    at = replace(axes, offset=offset)
    here = comparison.placed(at)
    bar = at.vjp(*here.measured_vjp(record, 0.3045, 1.7)).offset
    ends = (comparison.placed(replace(axes, offset=offset + h * direction)) for h in (0.5, -0.5))
    ahead, behind = (1.7 * end.loss(record, 0.3045) for end in ends)
    assert float(bar @ direction) == pytest.approx(ahead - behind, rel=1e-9)
    assert here.seen is comparison.seen
    assert not here.data[~here.seen].any()
    np.testing.assert_allclose(here.data[here.seen] - comparison.data[here.seen], offset * np.ones((here.count, dim)))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("size", [0.0, 1e-9, 5e-3, 0.7, 3.1])
def test_the_adjoint_of_a_rotation_by_dot_product(rng, dim, size):
    """A rotation turns values and still values about the origin of the file; its adjoint agrees with differences."""
    comparison, record = make(rng, dim, absolute=True), smooth_record(rng, dim)
    axes = Placement.none(dim)
    axis = rng.normal(size=axes.rotation.shape)
    at = Placement(rng.normal(size=dim), size * axis / np.linalg.norm(axis))
    direction = rng.normal(size=axis.shape)
    bar = at.vjp(*comparison.placed(at).measured_vjp(record, 0.3045, 1.7)).rotation

    def loss(h):
        return 1.7 * comparison.placed(replace(at, rotation=at.rotation + h * direction)).loss(record, 0.3045)

    h = 1e-3
    expected = (-loss(3 * h) + 9 * loss(2 * h) - 45 * loss(h) + 45 * loss(-h) - 9 * loss(-2 * h) + loss(-3 * h)) / (
        -60 * h
    )
    assert float(bar @ direction) == pytest.approx(expected, rel=1e-9)
    here = comparison.placed(at)
    np.testing.assert_allclose(at.matrix @ at.matrix.T, np.eye(dim), atol=1e-14)
    turned = np.einsum("de,...e->...d", at.matrix, comparison.data) + at.offset
    np.testing.assert_allclose(here.data[here.seen], turned[here.seen], rtol=1e-12, atol=1e-14)


def test_loss_is_the_mean_squared_distance_and_the_square_of_the_rmse(rng):
    comparison, record = make(rng), smooth_record(rng, 3)
    errors = comparison.model(record, 0.3) - comparison.data
    distances = np.sqrt((errors**2).sum(axis=2))[comparison.seen]
    misfit = comparison.misfit(record, 0.3)
    assert comparison.loss(record, 0.3) == pytest.approx(np.mean(distances**2))
    assert misfit.total == pytest.approx(np.sqrt(np.mean(distances**2)))
    of_b = np.sqrt((errors[:, 1] ** 2).sum(axis=1))[comparison.seen[:, 1]]
    assert misfit.channels["b"] == pytest.approx(np.sqrt(np.mean(of_b**2)))
    assert (~comparison.seen).sum() > 10


@pytest.mark.parametrize("absolute", [False, True])
def test_its_own_motion_has_no_error(rng, absolute):
    record, start, time = smooth_record(rng, 2), 0.3, 0.02 * np.arange(60)
    observer = Points(None, 0.1 * rng.normal(size=(3, 2)))
    y, _ = observer.observe(record)
    values = np.full((60, 3, 2), np.nan)
    values[15:46] = y if absolute else y - y[0]
    values[:15] = y[0] if absolute else 0.0
    comparison = compared(observer, time, values, start=start, absolute=absolute)
    assert len(comparison.times) == STEPS + 1
    assert comparison.loss(record, start) < 1e-28


def test_the_frames_that_count_do_not_depend_on_start(rng):
    comparison, record = make(rng), smooth_record(rng, 3)
    assert comparison.times[0] >= 0.25
    assert comparison.times[0] < 0.25 + 0.013
    assert 0.25 + STEP * STEPS - 0.013 < comparison.times[-1] <= 0.25 + STEP * STEPS
    starts = np.linspace(0.25, 0.35, 201)
    losses = np.array([comparison.loss(record, start) for start in starts])
    assert np.abs(np.diff(losses, 2)).max() < 1e-2 * np.ptp(losses), "no jump where a frame passes the release"


def test_what_is_skipped_is_compared_from_no_start(rng):
    """Time after the release that does not count: after the latest release that is allowed."""
    assert 0.45 <= make(rng, skip=0.1).times[0] < 0.45 + 0.013
    assert 0.4 <= make(rng, skip=0.1, start_bounds=None).times[0] < 0.4 + 0.013
    np.testing.assert_array_equal(make(rng, skip=0.1).times[-1], make(rng).times[-1])


def test_before_the_release_the_model_rests(rng):
    comparison, record = make(rng, gaps=False), smooth_record(rng, 3)
    tracks = comparison.model(record, 0.35)
    before = comparison.times < 0.35
    assert before.sum() >= 7
    np.testing.assert_allclose(tracks[before], 0.0, atol=1e-15)
    assert np.abs(tracks[~before][1:]).min(axis=(1, 2)).max() > 0


def test_a_start_outside_its_bounds_is_an_error(rng):
    with pytest.raises(ValueError, match="after the rollout's end"):
        make(rng).residuals(smooth_record(rng, 3), 0.2)


@pytest.mark.parametrize(("start", "steps"), [(-0.1, 30), (0.9, 30), (0.3, 60)])
def test_window_outside_the_recording(rng, start, steps):
    with pytest.raises(DataError, match=r"beam: the window, .*does not lie inside the recording, 0 to 1.287 s"):
        make(rng, start=start, steps=steps, start_bounds=None, source="beam")


def test_nothing_to_see(rng):
    time, values = 0.01 * np.arange(100), np.full((100, 3, 2), np.nan)
    values[90:] = 0.0
    with pytest.raises(DataError, match=r"no marker is seen between 0.1 and 0.5 s"):
        compared(Points(None), time, values, control_step=0.01, steps=40, start=0.1)
    with pytest.raises(DataError, match=r"only one frame lies between 0 and 0.4 s, which .* run from 0 to 990$"):
        compared(Points(None), 1e3 * time, values, control_step=0.01, steps=40, start=0.0)  # in ms
    with pytest.raises(DataError, match="no frame lies between"):
        compared(Points(None), 0.5 * np.arange(100), values, control_step=0.01, steps=4, start=0.1)


def test_a_marker_never_seen_in_the_window_has_no_rmse(rng):
    comparison = make(rng, gaps=False)
    comparison.seen[:, 2] = False
    comparison.count = int(comparison.seen.sum())
    misfit = comparison.misfit(smooth_record(rng, 3), 0.3)
    assert np.isnan(misfit.channels["c"])
    assert misfit.total > 0
    assert len(comparison.series()) == 6


def test_series_are_single_coordinates_in_order_of_time(rng):
    comparison, record = make(rng), smooth_record(rng, 3)
    r = comparison.residuals(record, 0.3)
    errors = comparison.model(record, 0.3) - comparison.data
    series = comparison.series()
    assert sorted(np.concatenate([where for where, _, _ in series])) == list(range(r.size))
    where, frames, still = series[3 * 1 + 2]
    assert still.size == 0
    np.testing.assert_array_equal(r[where], errors[frames, 1, 2])
    np.testing.assert_array_equal(frames, np.flatnonzero(comparison.seen[:, 1]))


def test_series_have_the_still_values_of_their_marker_and_axis(rng):
    still = rng.normal(size=(5, 3, 3))
    series = make(rng, still=still).series()
    np.testing.assert_array_equal(series[3 * 1 + 2][2], still[:, 1, 2])
