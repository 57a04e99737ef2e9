"""Splines: control points of polynomials and B-splines, exact values, and how far curves are from straight lines."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from support.cases import mostly_slow

import pgccd
from pgccd.motion.splines import Spline

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def exact(control: list[float], s: Fraction) -> Fraction:
    """The Bernstein polynomial with these control points, by de Casteljau's algorithm."""
    points = [Fraction(x) for x in control]
    while len(points) > 1:
        points = [a + s * (b - a) for a, b in zip(points, points[1:], strict=False)]
    return points[0]


def exact_b_spline(knots: list[float], control: list[float], degree: int, time: Fraction) -> Fraction:
    """By the recursion of Cox and de Boor; at the last knot from the left."""
    t = [Fraction(x) for x in knots]
    last = max(k for k in range(degree, len(control)) if t[k] < t[k + 1])
    span = next((k for k in range(degree, last) if t[k] <= time < t[k + 1]), last)
    basis = [Fraction(int(k == span)) for k in range(len(knots) - 1)]
    for d in range(1, degree + 1):
        for k in range(len(knots) - 1 - d):
            left = (time - t[k]) / (t[k + d] - t[k]) * basis[k] if t[k + d] > t[k] else Fraction(0)
            right = t[k + d + 1] - t[k + 1]
            basis[k] = left + ((t[k + d + 1] - time) / right * basis[k + 1] if right > 0 else 0)
    return sum((Fraction(c) * b for c, b in zip(control, basis, strict=False)), Fraction(0))


@pytest.mark.parametrize("seed", mostly_slow(range(12), [0, 1, 2]))
def test_polynomials_within_their_error(seed: int) -> None:
    """Exact values of the polynomials, also such that cancel, and those of the control points."""
    rng = np.random.default_rng(seed)
    degree, segments = int(rng.integers(1, 17)), int(rng.integers(1, 5))
    times = np.cumsum(rng.uniform(0.1, 3.0, segments + 1)) * 10.0 ** rng.uniform(-3, 3)
    terms = rng.normal(size=(degree + 1, segments)) / np.diff(times) ** np.arange(degree, -1, -1)[:, None]
    for k in range(1, segments):  # without jumps
        h = times[k] - times[k - 1]
        terms[-1, k] = sum(terms[m, k - 1] * h ** (degree - m) for m in range(degree + 1))
    spline = Spline.from_polynomials(torch.tensor(terms), times)
    assert spline.degree == degree and spline.segment_count == segments
    sizes = [
        abs(float(terms[m, k]) * (times[k + 1] - times[k]) ** (degree - m))
        for k in range(segments)
        for m in range(degree + 1)
    ]
    assert spline.error <= 2.0**-45 * sum(sizes)
    worst = Fraction(0)
    for k in range(segments):
        control = spline.segments()[k].tolist()
        h = Fraction(float(times[k + 1])) - Fraction(float(times[k]))
        for s in map(Fraction, np.linspace(0.0, 1.0, 9).tolist()):
            of_powers = sum(Fraction(float(terms[m, k])) * (s * h) ** (degree - m) for m in range(degree + 1))
            worst = max(worst, abs(exact(control, s) - of_powers))
    assert worst <= Fraction(spline.error) and (degree < 3 or worst > 0)


@pytest.mark.parametrize("seed", mostly_slow(range(12), [0, 1, 2]))
def test_b_splines_within_their_error(seed: int) -> None:
    """With knots that meet, clamped or not."""
    rng = np.random.default_rng(seed)
    degree = int(rng.integers(1, 8))
    count = degree + int(rng.integers(1, 7))
    knots = np.sort(rng.integers(0, 12, count + degree + 1) * rng.uniform(0.1, 10.0))
    if rng.random() < 0.5:
        knots[:degree], knots[-degree:] = knots[degree], knots[-degree - 1]
    if knots[degree] == knots[count]:
        knots[count:] += 1.0
    for k in range(degree + 1, count):  # a knot met by all of a polynomial is a jump
        if knots[k + 1] == knots[k - degree + 1]:
            return
    control = rng.normal(size=(count, 2)) * [1.0, 1e3]
    try:
        spline = Spline.from_b_spline(knots, torch.tensor(control), degree)
    except ValueError as error:
        assert "without jumps" in str(error)
        return
    assert spline.error <= 2.0**-45 * np.abs(control).max()
    for k in range(spline.segment_count):
        begin, end = (Fraction(float(spline.times[n])) for n in (k, k + 1))
        for s in map(Fraction, (0.0, 0.3, 0.75)):
            for column in range(2):
                given = exact_b_spline(knots.tolist(), control[:, column].tolist(), degree, begin + s * (end - begin))
                made = exact(spline.segments()[k, :, column].tolist(), s)
                assert abs(made - given) <= Fraction(spline.error)
                at = float(spline.at(float(begin + s * (end - begin)))[column])
                assert abs(at - float(given)) <= 1e-11 * np.abs(control).max() * (1.0 + float(end / (end - begin)))


def test_scipy_agrees() -> None:
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(0)
    times = [0.0, 0.1, 0.5, 2.0]
    cubic = interpolate.CubicSpline(times, rng.normal(size=(4, 2, 3)))
    spline = Spline.from_polynomials(cubic.c, cubic.x)
    at = np.linspace(0.0, 2.0, 33)
    assert np.allclose(spline.at(at), cubic(at), rtol=0, atol=1e-12) and spline.control.shape == (10, 2, 3)
    basic = interpolate.make_interp_spline(times, rng.normal(size=(4, 2)), k=3)
    assert np.allclose(Spline.from_b_spline(basic.t, basic.c, basic.k).at(at), basic(at), rtol=0, atol=1e-13)


def test_a_gap_at_a_breakpoint_is_in_the_error() -> None:
    """What float32 rounds is allowed for; a jump is refused."""
    terms = np.array([[[1.0], [1.0]], [[0.0], [1.0 + 1e-7]]])
    spline = Spline.from_polynomials(terms, [0.0, 1.0, 2.0])
    assert 1e-7 <= spline.error <= 1.1e-7
    with pytest.raises(ValueError, match="^coefficients: expected a curve without jumps, got one of 0.5 at time 1"):
        Spline.from_polynomials(np.array([[[1.0], [1.0]], [[0.0], [1.5]]]), [0.0, 1.0, 2.0])
    with pytest.raises(ValueError, match="^control: expected a curve without jumps"):
        Spline.from_b_spline([0, 0, 1, 1, 2, 2], [[0.0], [1.0], [3.0], [4.0]], 1)


def test_bad_input_is_named() -> None:
    line = torch.tensor([[0.0], [1.0]])
    bad = [
        (lambda: Spline(line, 0), "^degree: expected an integer from 1 to 16"),
        (lambda: Spline(line, 17), "^degree: expected an integer from 1 to 16, got 17"),
        (lambda: Spline(line, 2), r"^control: expected shape \(S 2 \+ 1, ...\)"),
        (lambda: Spline(line.requires_grad_(), 1), "^control: requires grad"),
        (lambda: Spline(line.detach(), 1, times=[0.0, 0.0]), "^times: expected finite increasing times"),
        (lambda: Spline(line.detach(), 1, times=[0.0]), r"^times: expected shape \(2,\)"),
        (lambda: Spline.from_polynomials(np.zeros(3), [0, 1]), "^coefficients: expected shape"),
        (lambda: Spline.from_polynomials(np.zeros((1, 1)), [0, 1]), "^coefficients: degree: expected an integer"),
        (lambda: Spline.from_polynomials(np.full((2, 1), np.nan), [0, 1]), "^coefficients: expected finite"),
        (lambda: Spline.from_polynomials(np.zeros((2, 1)), [0, np.inf]), "^breakpoints: expected finite"),
        (lambda: Spline.from_b_spline([0, 0, 1, 1], line.detach()[:1], 1), "^control: expected more than 1"),
        (lambda: Spline.from_b_spline([0, 1, 1], line.detach(), 1), r"^knots: expected shape \(4,\)"),
        (lambda: Spline.from_b_spline([0, 1, 0, 1], line.detach(), 1), "^knots: expected finite times"),
        (lambda: Spline.from_b_spline([0, 1, 1, 2], line.detach(), 1), "^knots: expected finite times"),
    ]
    for call, message in bad:
        with pytest.raises(ValueError, match=message):
            call()


def test_times_of_contacts() -> None:
    spline = Spline(torch.tensor([0.0, 1.0, 3.0]), 1, times=[1.0, 1.5, 4.0])
    found = spline.time_of(torch.tensor([0, 1, 1, -1]), torch.tensor([0.0, 0.5, 1.0, torch.inf], dtype=torch.float64))
    assert found[0] == 1.0 and 2.75 - 1e-14 < found[1] <= 2.75 and 4.0 - 1e-14 < found[2] <= 4.0
    assert found[3] == torch.inf


def test_curves_are_near_straight_lines() -> None:
    """The bound of how far they are is attained by parabolas, and never exceeded; it has the rounding of values."""
    rng = np.random.default_rng(2)
    parabola = Spline(torch.tensor([0.0, 1.0, 0.0]), 2)
    for parts in (1, 4):
        values, off = parabola._divided(parts)
        middle = parabola.at((torch.arange(parts) + 0.5) / parts)
        attained = (middle - 0.5 * (values[1:] + values[:-1])).abs() / off
        assert bool((attained <= 1.0).all()) and bool((attained > 0.9999).all())
    for _ in range(20):
        degree = int(rng.integers(1, 9))
        spline = Spline(torch.tensor(rng.normal(size=(2 * degree + 1, 3))), degree)
        values, off = spline._divided(3)
        for k in range(6):
            for s in (0.25, 0.5, 0.75):
                line = (1.0 - s) * values[k] + s * values[k + 1]
                assert bool(((spline.at((k + s) / 3) - line).abs() <= off[k]).all())
    constant = Spline(torch.full((6,), 1e3), 5)
    constant.error = 0.125
    off = constant._divided(1)[1]
    assert abs(float(off[0]) / (25.0 * 1e3 * 2.0**-50 + 0.125) - 1.0) < 1e-11 and float(off[0]) > 0.125


def test_trajectories_of_splines() -> None:
    """A ball on a parabola that grazes another one at its apex is found, whatever the parts; its margins are as small
    as was asked for, and cover the curve.
    """
    ball = pgccd.Mesh.sphere(0.1)
    scene = pgccd.Scene([ball, ball])
    # Height 2 s (1 - s) over the segment: 0.5 at its middle.
    for depth, is_met in ((1e-9, True), (-2e-3, False)):
        control = torch.zeros(3, 2, 3, dtype=torch.float64)
        control[:, 0, 0] = torch.tensor([-1.0, 0.0, 1.0])
        control[1, 0, 2] = 1.0
        control[:, 1, 2] = 0.7 - depth
        upright = UPRIGHT.expand(2, 4)
        for stray in (0.2, 1e-2, 1e-3):
            path = pgccd.Trajectory.from_spline(Spline(control, 2), upright, stray=stray)
            assert path.margin is not None and float(path.margin.max()) <= stray * (1.0 + 1e-9)
            if is_met or stray == 1e-3:
                assert bool(len(pgccd.detect(scene, path))) == is_met, stray


def test_orientations_along_splines() -> None:
    """Bodies rotate between breakpoints at constant rates, whatever the number of parts."""
    rng = np.random.default_rng(4)
    control = torch.tensor(rng.normal(size=(7, 2, 3)))
    turned = torch.nn.functional.normalize(torch.tensor(rng.normal(size=(3, 2, 4))), dim=-1)
    path = pgccd.Trajectory.from_spline(Spline(control, 3), turned, stray=1e-2)
    parts = path.segment_count // 2
    assert parts > 4 and path.orientation is not None
    assert torch.allclose(path.orientation[::parts].abs(), turned.abs(), rtol=0, atol=1e-12)
    ends = pgccd.Trajectory(control[::3], turned)
    for k in range(2):
        expected = ends.segment(k).at(0.5)[1]
        assert parts % 2 or torch.allclose(path.orientation[k * parts + parts // 2].abs(), expected.abs(), atol=1e-12)
    rotation = torch.tensor(rng.normal(size=(2, 2, 3))) * 5.0
    spinning = pgccd.Trajectory.from_spline(Spline(control, 3), turned[0], rotation=rotation, stray=1e-2)
    last = pgccd.Trajectory(control[::3], turned[0], rotation=rotation).orientation
    assert last is not None and spinning.orientation is not None
    assert torch.allclose(spinning.orientation[-1], last[-1], rtol=0, atol=1e-12)
    still = pgccd.Trajectory.from_spline(Spline(control, 3), turned[0], stray=1e-2)
    assert still.orientation is not None and torch.equal(still.orientation[-1], turned[0])


def test_vertices_along_splines() -> None:
    """Margins of deforming bodies are those of their vertices; corners of paths that bulge out are met."""
    triangle = pgccd.Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))
    scene = pgccd.Scene([triangle, triangle])
    control = torch.zeros(3, 6, 3, dtype=torch.float64)
    control[:] = torch.cat([triangle.vertices, triangle.vertices]).to(torch.float64)
    control[1, :3, 2] += 1.0  # to height 0.5, and back
    control[:, 3:, 2] = 0.5 - 1e-9
    spline = Spline(control, 2)
    path = pgccd.Trajectory.from_spline(spline, stray=0.01, vertex_counts=[3, 3])
    assert path.margin is not None and path.margin.shape[1] == 2
    assert float(path.margin[:, 0].min()) > 1e-3 and float(path.margin[:, 1].max()) < 1e-12
    assert len(pgccd.detect(scene, path)) > 0
    assert pgccd.Trajectory.from_spline(spline, stray=0.01).margin.shape[1] == 1  # type: ignore[union-attr]


def test_bad_trajectories_are_named() -> None:
    spline = Spline(torch.zeros(3, 1, 3), 2)
    curved = Spline(torch.tensor([[[0.0, 0, 0]], [[1.0, 0, 0]], [[0.0, 0, 0]]]), 2)
    bad = [
        (lambda: pgccd.Trajectory.from_spline(Spline(torch.zeros(3, 2), 2), stray=0.1), "^position: expected a spline"),
        (lambda: pgccd.Trajectory.from_spline(spline, UPRIGHT, stray=0.0), "^stray: expected a length > 0"),
        (lambda: pgccd.Trajectory.from_spline(curved, UPRIGHT, stray=1e-14), "^stray: expected a larger length"),
        (lambda: pgccd.Trajectory.from_spline(spline, stray=0.1, rotation=torch.zeros(1, 1, 3)), "^rotation: expected"),
        (lambda: pgccd.Trajectory.from_spline(spline, stray=0.1, vertex_counts=[2]), "^vertex_counts: expected"),
        (lambda: pgccd.Trajectory.from_spline(spline, UPRIGHT.expand(2, 4), stray=0.1), "^orientation: "),
    ]
    for call, message in bad:
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="^position: "):
        pgccd.Trajectory.from_spline(torch.zeros(3, 1, 3), stray=0.1)  # type: ignore[arg-type]


def test_splines_on_devices(device: torch.device) -> None:
    spline = Spline(torch.tensor([[0.0, 1.0], [2.0, 1.0], [3.0, 4.0]], device=device), 2)
    assert spline.device.type == device.type and spline.at([0.5]).device.type == device.type
    assert math.isclose(float(spline.at(0.5)[0]), 1.75)
