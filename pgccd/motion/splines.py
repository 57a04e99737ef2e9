"""Splines: curves over time that are polynomials between breakpoints."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pgccd import arguments

#: Higher degrees are not read.
MOST_DEGREE = 16
# Rounding of a conversion to control points, in units of the largest sum of magnitudes: fewer than 64 operations, each
# with an error of half a unit in the last place.
_CONVERSION = 2.0**-47
# Rounding of values and of second differences, in units of the square of the degree times the largest number; and of
# sums of such bounds.
_VALUES, _UP = 2.0**-50, 1.0 + 2.0**-40
# How much polynomials may differ at a breakpoint, in units of the largest value: the rounding of float32.
_JUMP = 1e-6


class Spline:
    """Curves of numbers over time, such as joint values or positions, which are polynomials between breakpoints.

    Args:
        control: (S degree + 1, ...) control points of S segments, in the Bernstein basis (Bezier curves): those of
            segment k are rows k degree to (k + 1) degree, and consecutive segments share a row.
        degree: of the polynomials, from 1 to 16.
        times: (S + 1,) increasing breakpoints, time units. Default: 0 to S.

    Attributes:
        control: float64.
        degree: as given.
        times: (S + 1,) float64, on a CPU.
        error: bound of the difference between the given curves and those of the control points, by rounding of a
            conversion.

    Raises:
        TypeError, ValueError: naming the argument.

    Example:
        >>> curve = pgccd.Spline(torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), degree=2)
        >>> curve.at(0.5)
        tensor([0.2500, 0.7500], dtype=torch.float64)
    """

    def __init__(self, control: Tensor, degree: int, *, times: Tensor | Sequence[float] | None = None) -> None:
        self.degree = _degree(degree)
        control = arguments.real_tensor(control, "control")
        arguments.refuse_gradient(control, "control")
        expected = f"shape (S {self.degree} + 1, ...) of S >= 1 segments"
        if control.dim() < 1 or len(control) <= self.degree or (len(control) - 1) % self.degree:
            raise ValueError(f"control: expected {expected}, got {tuple(control.shape)}")
        self.control = control.detach().to(torch.float64).contiguous()
        given = range(self.segment_count + 1) if times is None else times
        self.times = torch.from_numpy(_breakpoints(given, "times", self.segment_count + 1))
        self.error = 0.0

    @classmethod
    def from_polynomials(
        cls, coefficients: Tensor | np.ndarray, breakpoints: Tensor | np.ndarray | Sequence[float]
    ) -> Spline:
        """From coefficients of powers, as `c` and `x` of SciPy's `PPoly`, `CubicSpline` and others.

        Args:
            coefficients: (degree + 1, S, ...): in segment k, the value at time t is the sum of coefficients[m, k] (t -
                breakpoints[k])^(degree - m).
            breakpoints: (S + 1,) increasing, time units.

        Raises:
            TypeError, ValueError: naming the argument; or the curve jumps at a breakpoint.

        Example:
            >>> line = pgccd.Spline.from_polynomials([[[2.0]], [[1.0]]], [0.0, 0.5])  # 1 + 2 t
            >>> line.at([0.0, 0.5]).tolist()
            [[1.0], [2.0]]
        """
        given = arguments.real_numbers(coefficients, "coefficients", "shape (degree + 1, S, ...)")
        if given.dim() < 2 or not given.shape[1]:
            raise ValueError(f"coefficients: expected shape (degree + 1, S, ...), got {tuple(given.shape)}")
        degree, segments = _degree(given.shape[0] - 1, "coefficients: degree"), given.shape[1]
        times = _breakpoints(breakpoints, "breakpoints", segments + 1)
        terms = given.detach().cpu().to(torch.float64).numpy()[::-1].copy()  # of power m in row m
        lengths = np.diff(times).reshape(-1, *[1] * (terms.ndim - 2))
        for power in range(1, degree + 1):
            terms[power:] *= lengths
        # b_k = sum over m <= k of (k over m) / (degree over m) a_m: Farin 2002.
        points = np.zeros_like(terms)
        for k in range(degree + 1):
            for m in range(k + 1):
                points[k] += (math.comb(k, m) / math.comb(degree, m)) * terms[m]
        size = float(np.abs(terms).sum(axis=0).max(initial=0.0))
        return cls._of_segments("coefficients", points, times, size, given.device)

    @classmethod
    def from_b_spline(
        cls,
        knots: Tensor | np.ndarray | Sequence[float],
        control: Tensor | np.ndarray,
        degree: int,
    ) -> Spline:
        """From a B-spline, as `t`, `c` and `k` of SciPy's `BSpline`, over the times on which its basis is complete.

        Args:
            knots: (n + degree + 1,) times that do not decrease.
            control: (n, ...) its control points, n > degree.
            degree: from 1 to 16.

        Raises:
            TypeError, ValueError: naming the argument; or the curve jumps at a knot.

        Example:
            >>> curve = pgccd.Spline.from_b_spline([0, 0, 0, 1, 2, 2, 2], [[0.0], [1.0], [1.0], [0.0]], 2)
            >>> curve.segment_count, curve.at(1.0).tolist()
            (2, [1.0])
        """
        degree = _degree(degree)
        given = arguments.real_numbers(control, "control", "shape (n, ...)")
        if given.dim() < 1 or len(given) <= degree:
            raise ValueError(f"control: expected more than {degree} control points, got shape {tuple(given.shape)}")
        t = arguments.real_numbers(knots, "knots", "times").detach().cpu().to(torch.float64).numpy()
        if t.shape != (len(given) + degree + 1,):
            raise ValueError(f"knots: expected shape ({len(given) + degree + 1},), got {t.shape}")
        if not (np.isfinite(t).all() and (np.diff(t) >= 0.0).all() and t[degree] < t[len(given)]):
            raise ValueError("knots: expected finite times that do not decrease, and differ within the curve")
        of = given.detach().cpu().to(torch.float64).numpy()
        spans = [k for k in range(degree, len(given)) if t[k] < t[k + 1]]
        # Control points of a segment are values of the polar form at its two ends in all numbers (Ramshaw 1989), which
        # de Boor's algorithm evaluates: means of control points, so nothing cancels.
        segments = [
            [_polar(t, of, k, [t[k]] * (degree - m) + [t[k + 1]] * m) for k in spans] for m in range(degree + 1)
        ]
        times = np.array([*(t[k] for k in spans), t[len(given)]])
        size = float(np.abs(of).max(initial=0.0))
        return cls._of_segments("control", np.array(segments), times, size, given.device)

    @classmethod
    def _of_segments(
        cls, name: str, points: np.ndarray, times: np.ndarray, size: float, device: torch.device
    ) -> Spline:
        """From control points (degree + 1, S, ...) of each segment, computed from numbers of up to this size."""
        if not np.isfinite(points).all():
            raise ValueError(f"{name}: expected finite numbers")
        degree, segments = points.shape[0] - 1, points.shape[1]
        jumps = np.abs(points[-1, :-1] - points[0, 1:])
        jumps = jumps.max(axis=tuple(range(1, jumps.ndim)), initial=0.0)
        jump = float(jumps.max(initial=0.0))
        if jump > _JUMP * size:
            at = int(np.argmax(jumps)) + 1
            raise ValueError(f"{name}: expected a curve without jumps, got one of {jump:.3g} at time {times[at]:.6g}")
        rows = np.concatenate(
            [points[:-1].swapaxes(0, 1).reshape(segments * degree, *points.shape[2:]), points[-1:, -1]]
        )
        made = cls(torch.from_numpy(rows).to(device), degree, times=times.tolist())
        made.error = jump + _CONVERSION * size
        return made

    @property
    def segment_count(self) -> int:
        """S."""
        return (len(self.control) - 1) // self.degree

    @property
    def device(self) -> torch.device:
        """The device of the control points."""
        return self.control.device

    def segments(self) -> Tensor:
        """(S, degree + 1, ...) the control points of each segment."""
        own = self.control[:-1].unflatten(0, (self.segment_count, self.degree))
        return torch.cat([own, self.control[self.degree :: self.degree, None]], dim=1)

    def at(self, time: Tensor | Sequence[float] | float) -> Tensor:
        """Values at times. Before the first breakpoint and after the last one, the value there.

        Args:
            time: (...) time units.

        Returns:
            (..., *control.shape[1:]) float64.

        Raises:
            TypeError, ValueError: `time` is not a number or a tensor of numbers.

        Example:
            >>> pgccd.Spline(torch.tensor([0.0, 2.0]), degree=1).at([0.25, 0.5])
            tensor([0.5000, 1.0000], dtype=torch.float64)
        """
        when = arguments.real_numbers(time, "time", "times").cpu().to(torch.float64)
        when = when.clamp(float(self.times[0]), float(self.times[-1]))
        segment = (torch.searchsorted(self.times, when, right=True) - 1).clamp(0, self.segment_count - 1)
        begin, end = self.times[segment], self.times[segment + 1]
        points = self.segments()[segment.to(self.device)].movedim(when.dim(), 0)
        return _values(points, ((when - begin) / (end - begin)).to(self.device))

    def _divided(self, parts: int) -> tuple[Tensor, Tensor]:
        """Values (S parts + 1, ...) at the ends of equal parts of all segments; and how far each number is from a
        straight line between them, at most, in each part (S parts, ...).
        """
        segments = self.segments()
        # Divided on the host: torch divides otherwise on a GPU.
        s = torch.tensor([k / parts for k in range(parts)], dtype=torch.float64, device=self.device)
        begins = _values(segments.movedim(1, 0)[:, :, None], s.expand(self.segment_count, -1))
        values = torch.cat([begins.flatten(0, 1), self.control[-1:]])
        bend = self.degree * (self.degree - 1) * _most_of_rows(segments.diff(n=2, dim=1).abs())
        size = segments.abs().amax(dim=1)
        off = bend * (0.125 / parts**2) + _VALUES * self.degree**2 * size + self.error
        return values, (off * _UP).repeat_interleave(parts, dim=0)

    def time_of(self, segment: Tensor, toi: Tensor) -> Tensor:
        """Times (K,), time units, of contacts at `toi` (K,) in [0, 1] of segments (K,); inf where the segment is -1.

        Args:
            segment: (K,) int64.
            toi: (K,) float64.

        Raises:
            IndexError: there is no such segment.

        Example:
            >>> line = pgccd.Spline(torch.tensor([0.0, 2.0]), degree=1, times=[3.0, 5.0])
            >>> line.time_of(torch.tensor([0, -1]), torch.tensor([0.0, torch.inf]))
            tensor([3., inf], dtype=torch.float64)
        """
        times = self.times.to(toi.device)
        begin, end = times[segment.clamp(min=0)], times[segment.clamp(min=0) + 1]
        time = begin + toi.clamp(max=1.0) * (end - begin)
        # Rounded towards the begin, so that it is never late.
        earlier = torch.maximum(begin, time - 2.0**-50 * torch.maximum(begin.abs(), end.abs()))
        return torch.where((segment < 0) | ~torch.isfinite(toi), torch.inf, torch.where(toi > 0.0, earlier, begin))

    def __repr__(self) -> str:
        shape = tuple(self.control.shape[1:])
        return f"Spline(segments={self.segment_count}, degree={self.degree}, values={shape}, device={self.device})"


def _values(control: Tensor, s: Tensor) -> Tensor:
    """Values of polynomials with control points (degree + 1, *s.shape, ...), at times in [0, 1]."""
    degree = len(control) - 1
    s = s.reshape(*s.shape, *[1] * (control.dim() - s.dim() - 1))
    # In the manner of Horner, by operations that round alike on every device.
    rest, power = 1.0 - s, torch.ones_like(s)
    total = control[0] * rest
    for k in range(1, degree):
        power = power * s
        total = (total + math.comb(degree, k) * power * control[k]) * rest
    return total + power * s * control[degree]


def _most_of_rows(values: Tensor) -> Tensor:
    """The largest of each column (S, n, ...); 0 without rows."""
    return values.amax(dim=1) if values.shape[1] else values.new_zeros(values.shape[0], *values.shape[2:])


def _degree(degree: int, name: str = "degree") -> int:
    expected = f"an integer from 1 to {MOST_DEGREE}"
    if arguments.integer(degree, name, 1, expected) > MOST_DEGREE:
        raise ValueError(f"{name}: expected {expected}, got {degree}")
    return int(degree)


def _breakpoints(times: Tensor | np.ndarray | Sequence[float], name: str, count: int) -> np.ndarray:
    values = arguments.real_numbers(list(times) if isinstance(times, range) else times, name, "increasing times")
    found = values.detach().cpu().to(torch.float64).numpy()
    if found.shape != (count,):
        raise ValueError(f"{name}: expected shape ({count},), got {found.shape}")
    if not (np.isfinite(found).all() and (np.diff(found) > 0.0).all()):
        raise ValueError(f"{name}: expected finite increasing times, got {found.tolist()}")
    return found


def _polar(knots: np.ndarray, control: np.ndarray, span: int, at: Sequence[float]) -> np.ndarray:
    """The polar form of the polynomial of a B-spline in a span of knots."""
    degree = len(at)
    points = [control[k] for k in range(span - degree, span + 1)]
    for level, u in enumerate(at, start=1):
        for k in range(degree, level - 1, -1):
            first = knots[span - degree + k]
            part = (u - first) / (knots[span + 1 + k - level] - first)
            points[k] = (1.0 - part) * points[k - 1] + part * points[k]
    return points[degree]
