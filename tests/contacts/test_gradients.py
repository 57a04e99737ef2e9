"""Gradients of contacts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from support.gradients import MOTIONS, errors, meshes, random_case
from torch import Tensor

import pgccd
from pgccd.motion.differentiable import sum_sorted

UPRIGHT = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2, dtype=torch.float64)
START = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.3, 0.2]], dtype=torch.float64)
END = torch.tensor([[0.0, 0.0, 0.0], [-0.7, 0.1, 0.0]], dtype=torch.float64)
TURN = torch.tensor([[0.1, 0.3, 0.2], [-0.4, 0.2, 0.5]], dtype=torch.float64)


def scene(device: torch.device | str = "cpu", **columns: Any) -> pgccd.Scene:
    return pgccd.Scene(meshes()[:1], [0, 0], device, **columns)


def wanting(values: Tensor) -> Tensor:
    return values.clone().requires_grad_()


def check_errors(motion: str, separated: bool, count: int, device: torch.device) -> None:
    found = errors(random_case(motion, count, separated, seed=1, device=device))
    for name, relative in found.items():
        assert len(relative) > 0.7 * count, name
        assert float(relative.median()) <= 1e-8, name
        assert float(relative.quantile(0.99)) <= 1e-5, name


@pytest.mark.parametrize("separated", [False, True], ids=["touching", "separated"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_derivatives_are_those_of_differences(motion: str, separated: bool, device: torch.device) -> None:
    check_errors(motion, separated, 200, device)


@pytest.mark.slow
@pytest.mark.parametrize("separated", [False, True], ids=["touching", "separated"])
@pytest.mark.parametrize("motion", MOTIONS)
def test_derivatives_of_many_contacts(motion: str, separated: bool, device: torch.device) -> None:
    check_errors(motion, separated, 12_000, device)


@pytest.mark.parametrize("path", ["rigid", "linear"])
def test_gradcheck(path: pgccd.motion.paths.PathKind, device: torch.device) -> None:
    margin, separation = torch.tensor([0.01, 0.02], dtype=torch.float64), torch.tensor(0.013, dtype=torch.float64)

    def columns(x0: Tensor, q0: Tensor, x1: Tensor, turn: Tensor, margin: Tensor, separation: Tensor) -> Any:
        motion = pgccd.RigidMotion.from_rotation(x0, q0, x1, turn, path)
        hits = pgccd.detect(scene(device, margin=margin), motion, min_separation=separation, tolerance=1e-12)
        assert hits.differentiable.tolist() == [True]
        return hits.toi, hits.coordinates, hits.point, hits.normal, hits.first_toi(), hits.first_toi("body")

    inputs = [wanting(x.to(device)) for x in (START, UPRIGHT, END, TURN, margin, separation)]
    assert torch.autograd.gradcheck(columns, inputs, eps=1e-5, atol=1e-6)


def test_gradients_pass_through_motions(device: torch.device) -> None:
    """Two orientations, velocities, shortened paths, and poses at times that have gradients themselves."""
    other = torch.nn.functional.normalize(UPRIGHT + torch.tensor([[0.0, 0.2, 0.1, -0.1]]).double(), dim=1).to(device)

    def by_orientations(q0: Tensor, q1: Tensor, x1: Tensor) -> Any:
        ends = [q / q.norm(dim=1, keepdim=True) for q in (q0, q1)]
        motion = pgccd.RigidMotion(START.to(device), ends[0], x1, ends[1])
        hits = pgccd.detect(scene(device), motion.shortened(0.9), tolerance=1e-12)
        return hits.toi, motion.rotation, *motion.at(0.3), *motion.at(hits.first_toi())

    inputs = [wanting(x.to(device)) for x in (UPRIGHT, other, END)]
    assert torch.autograd.gradcheck(by_orientations, inputs, eps=1e-5, atol=1e-6)

    def by_velocities(x: Tensor, v: Tensor, omega: Tensor) -> Any:
        motion = pgccd.RigidMotion.from_velocity(x, UPRIGHT.to(device), v, omega, dt=0.5)
        return pgccd.detect(scene(device), motion[[0, 1]], tolerance=1e-12).point

    inputs = [wanting(x.to(device)) for x in (START, 2.0 * (END - START), 2.0 * TURN)]
    assert torch.autograd.gradcheck(by_velocities, inputs, eps=1e-5, atol=1e-6)


def test_gradients_at_half_a_turn(device: torch.device) -> None:
    """Between orientations exactly half a turn apart the derivative is that of the direction taken."""
    end = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.6, 0.8]], dtype=torch.float64)

    def rotation(q: Tensor) -> Tensor:
        return pgccd.RigidMotion(START.to(device), UPRIGHT.to(device), END.to(device), q).rotation

    q = wanting(end.to(device))
    along = torch.tensor([[0.0, 0.3, 0.2, -0.1], [1.0, 0.2, 0.8, -0.6]], dtype=torch.float64, device=device)
    after, at = (rotation(torch.nn.functional.normalize(q.detach() + h * along, dim=1)) for h in (1e-7, 0.0))
    for k in range(3):
        (gradient,) = torch.autograd.grad(rotation(q)[:, k].sum(), q)
        assert torch.allclose((gradient * along).sum(1), (after - at)[:, k] / 1e-7, atol=1e-5)


def test_gradients_pass_through_trajectories(device: torch.device) -> None:
    """Waypoints, rotations of segments, and margins of segments beside those of bodies."""
    x = torch.stack([START - 0.1 * (END - START), START, END]).to(device)
    q = torch.stack([UPRIGHT, UPRIGHT, pgccd.integrate_orientation(UPRIGHT, TURN)]).to(device)
    turn = torch.stack([torch.zeros_like(TURN), TURN]).to(device)

    def contacts(x: Tensor, margin: Tensor, of_bodies: Tensor) -> Any:
        trajectory = pgccd.Trajectory(x, q, rotation=turn, margin=margin)
        hits = pgccd.detect(scene(device, margin=of_bodies), trajectory, tolerance=1e-12)
        assert bool(hits.differentiable.all()) and len(hits) > 0
        return hits.toi, hits.time, hits.point

    margins = torch.full((2, 2), 0.01, dtype=torch.float64), torch.full((2,), 0.02, dtype=torch.float64)
    inputs = [wanting(values.to(device)) for values in (x, *margins)]
    assert torch.autograd.gradcheck(contacts, inputs, eps=1e-5, atol=1e-6)
    trajectory = pgccd.Trajectory(x, q, rotation=wanting(turn))
    pgccd.detect(scene(device), trajectory).toi.sum().backward()
    assert trajectory.rotation is not None and bool(trajectory.rotation.grad[1].any())
    with pytest.raises(ValueError, match="^angular_velocity: requires grad"):
        pgccd.Trajectory.from_velocity(x[0], q[0], turn, wanting(turn), 1.0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("test", [pgccd.narrow.vertex_face, pgccd.narrow.edge_edge])
@pytest.mark.parametrize("separation", [0.0, 0.05])
def test_elementary_tests(
    test: Callable[..., pgccd.narrow.ElementaryResult], separation: float, dtype: torch.dtype, device: torch.device
) -> None:
    random = torch.Generator().manual_seed(3)
    start, end, by_start, by_end = (
        torch.randn(2000, 4, 3, dtype=torch.float64, generator=random).float().double().to(device) for _ in range(4)
    )
    distance = torch.tensor(separation, dtype=torch.float64, requires_grad=True)
    found = test(wanting(start.to(dtype)), wanting(end.to(dtype)), distance, 1e-12)
    assert found.differentiable.sum() > 100 and found.toi.dtype == dtype
    assert not found.differentiable[(found.status != pgccd.Status.TOUCH) | (found.toi == 0.0)].any()
    points = [wanting(start.to(dtype)), wanting(end.to(dtype))]
    found = test(*points, distance, 1e-12)
    found.toi[found.differentiable].sum().backward()
    along = (points[0].grad * by_start + points[1].grad * by_end).sum((1, 2)).double()  # type: ignore[operator]
    step = 1e-5
    before, after = (test(start + k * step * by_start, end + k * step * by_end, separation, 1e-12) for k in (-1, 1))
    kept = found.differentiable & before.toi.isfinite() & after.toi.isfinite()
    difference = (after.toi - before.toi) / (2.0 * step)
    relative = ((along - difference).abs() / difference.abs())[kept]
    assert float(relative.median()) < (1e-4 if dtype == torch.float32 else 1e-7)
    assert float(relative.quantile(0.95)) < (1e-2 if dtype == torch.float32 else 1e-4)
    if separation:
        nearer, further = (test(start, end, separation + k * step, 1e-12).toi for k in (-1, 1))
        expected = ((further - nearer) / (2.0 * step))[kept].sum()
        points = [wanting(start), wanting(end)]
        (slope,) = torch.autograd.grad(test(*points, distance, 1e-12).toi[kept].sum(), distance)
        assert abs(float(slope) / float(expected) - 1.0) < 0.2  # a few that graze contribute most


def test_two_balls(device: torch.device) -> None:
    """Two equal balls on a line, one pushed at the other: where the first is at the impact, and where the second goes,
    follow (1, 0, 1, 0) from positions and velocities. Other engines return (0.75, 0.25, 0.91, 0.08).

    An elastic impact exchanges velocities. With a step of 1 the first ball then ends where the second would have been
    at its velocity, continued from the place of contact: x1' = x1 + toi v1 + (1 - toi) v2, and x2' likewise.
    """
    # Balls as points with margins: exact.
    ball = pgccd.Mesh.icosphere(1e-3, subdivisions=0)
    x = torch.tensor([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]], dtype=torch.float64, device=device, requires_grad=True)
    v = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64, device=device, requires_grad=True)
    bodies = pgccd.Scene([ball], [0, 0], device, margin=0.5)
    still = torch.zeros_like(x)
    motion = pgccd.RigidMotion.from_velocity(x, UPRIGHT.to(device), v, still, dt=1.0)
    hits = pgccd.detect(bodies, motion, tolerance=1e-12)
    toi = hits.first_toi()
    end = x + toi * v + (1.0 - toi) * v.flip(0)
    of_x, of_v = torch.autograd.grad(end[1, 0], (x, v))
    slopes = [float(of_x[0, 0]), float(of_x[1, 0]), float(of_v[0, 0]), float(of_v[1, 0])]
    assert slopes == pytest.approx([1.0, 0.0, 1.0, 0.0], abs=1e-12)


def test_bits_do_not_depend_on_gradients(device: torch.device) -> None:
    case = random_case("arcs", 50, True, seed=2, device=device)
    plain = case.detect(case.inputs)
    with_gradients = case.detect({name: wanting(x) for name, x in case.inputs.items()})
    assert plain == with_gradients
    assert with_gradients.toi.requires_grad and not plain.toi.requires_grad
    assert not plain.differentiable.any() and with_gradients.differentiable.any()
    with torch.no_grad():
        without = case.detect({name: wanting(x) for name, x in case.inputs.items()})
    assert plain == without and not without.point.requires_grad


def test_gradients_are_the_same_in_every_run(device: torch.device) -> None:
    """Many contacts of one body: sums are in the order of the rows."""
    count = 300
    index = torch.zeros(count + 1, dtype=torch.int64)
    away = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    x0 = torch.cat([torch.zeros(1, 3), 4.0 * away]).double().to(device)
    bodies = pgccd.Scene(meshes()[2:], index, device, group=[1] + [2] * count, mask=[2] + [1] * count)
    upright = UPRIGHT[:1].repeat(count + 1, 1).to(device)
    seen = []
    for _ in range(3):
        start = wanting(x0)
        motion = pgccd.RigidMotion.from_velocity(start, upright, -0.9 * x0, 0.3 * x0.flip(1), dt=1.0)
        hits = pgccd.detect(bodies, motion)
        assert len(hits) == count
        seen += torch.autograd.grad((hits.toi * hits.point.sum(1)).sum(), start)
    assert torch.equal(seen[0], seen[1]) and torch.equal(seen[0], seen[2])
    assert float(seen[0][0].abs().sum()) > 0.0


def test_sums_are_in_the_order_of_rows(device: torch.device) -> None:
    random = torch.Generator().manual_seed(5)
    terms = torch.randn(4000, 3, dtype=torch.float64, generator=random)
    row = torch.randint(0, 30, (4000,), generator=random)
    row[row == 7] = 8
    expected = torch.zeros(30, 3, dtype=torch.float64).index_add_(0, row, terms)
    found = sum_sorted(terms.to(device), row.to(device), 30)
    assert torch.allclose(found.cpu(), expected, rtol=1e-12, atol=1e-12) and not found[7].any()
    assert torch.equal(found, sum_sorted(terms.to(device), row.to(device), 30))
    assert not sum_sorted(terms[:0].to(device), row[:0].to(device), 4).any()


def test_where_there_is_no_derivative(device: torch.device) -> None:
    """Contacts at the start, and such as graze."""
    x0 = wanting(torch.tensor([[0.0, 0, 0], [0.1, 0, 0]], dtype=torch.float64, device=device))
    motion = pgccd.RigidMotion(x0, UPRIGHT.to(device), x0 + 1.0, UPRIGHT.to(device))
    hits = pgccd.detect(scene(device), motion)
    assert hits.toi.tolist() == [0.0] and hits.differentiable.tolist() == [False]
    gradient = torch.autograd.grad(hits.toi.sum() + hits.point.sum() + hits.normal.sum(), x0)[0]
    assert not gradient.any()

    # A box that slides along another at the separation.
    box = pgccd.Scene([pgccd.Mesh.box([2.0, 2.0, 2.0])], [0, 0], device)
    x0 = wanting(torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.1, 2.1]], dtype=torch.float64, device=device))
    x1 = torch.tensor([[0.0, 0.0, 0.0], [-4.0, 0.1, 2.1]], dtype=torch.float64, device=device)
    motion = pgccd.RigidMotion(x0, UPRIGHT.to(device), x1, UPRIGHT.to(device))
    hits = pgccd.detect(box, motion, "all", min_separation=0.1 + 1e-9)
    assert len(hits) > 0 and not hits.differentiable[hits.normal[:, 2].abs() > 1.0 - 1e-9].any()
    assert torch.autograd.grad(hits.toi.sum(), x0)[0].isfinite().all()


def test_without_contacts(device: torch.device) -> None:
    x0 = wanting(START.to(device))
    hits = pgccd.detect(scene(device), pgccd.RigidMotion(x0, UPRIGHT.to(device), x0, UPRIGHT.to(device)))
    assert len(hits) == 0 and hits.differentiable.shape == (0,)
    loss = hits.first_toi().clamp(max=1.0) + hits.point.sum()
    assert not torch.autograd.grad(loss, x0)[0].any()


def test_rows_keep_their_gradients(device: torch.device) -> None:
    case = random_case("arcs", 20, False, seed=4, device=device)
    inputs = {name: wanting(x) for name, x in case.inputs.items()}
    hits = case.detect(inputs)
    some = hits[[3, 1]].to("cpu").clone()
    assert some.differentiable.shape == (2,) and some.differentiable.all() and some.toi.requires_grad
    first = hits.earliest()
    assert torch.autograd.grad(first.toi.sum(), inputs["x0"], retain_graph=True)[0].any()
    by_body = hits.first_toi("world").clamp(max=1.0).sum()
    total = torch.autograd.grad(by_body, inputs["x0"], retain_graph=True)[0]
    assert torch.allclose(total, torch.autograd.grad(hits.toi.sum(), inputs["x0"])[0], rtol=1e-12)


def test_a_body_with_itself(device: torch.device) -> None:
    """A corner of a mesh meets a face of it."""
    corners = [[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [0.3, 0.2, 1], [0.1, 0.9, 1.2], [0.5, 0.6, 1.5]]
    sheet = pgccd.Mesh(corners, [[0, 2, 1], [1, 2, 3], [4, 5, 6]])
    folding = pgccd.Scene([sheet], device=device, self_collision=True)
    x0 = sheet.vertices.to(device)
    x1 = x0.clone()
    x1[4:, 2] = torch.tensor([-0.5, 0.4, 0.7], dtype=torch.float64)

    def toi(x0: Tensor, x1: Tensor) -> Any:
        hits = pgccd.detect(folding, pgccd.VertexMotion(x0, x1), tolerance=1e-12)
        assert hits.pairs.tolist() == [[0, 0]]
        return hits.toi, hits.point

    assert torch.autograd.gradcheck(toi, (wanting(x0), wanting(x1)), eps=1e-5, atol=1e-6)


def test_second_derivatives_are_refused(device: torch.device) -> None:
    x0 = wanting(START.to(device))
    motion = pgccd.RigidMotion(x0, UPRIGHT.to(device), END.to(device), UPRIGHT.to(device))
    hits = pgccd.detect(scene(device), motion)
    for name in ("toi", "point", "normal", "coordinates"):
        with pytest.raises(NotImplementedError, match=f"^{name}: has first derivatives only"):
            torch.autograd.grad(getattr(hits, name).sum(), x0, create_graph=True)


def test_second_derivatives_of_all_entries_are_refused(device: torch.device) -> None:
    """Also in float32, of trajectories, margins, separations, and elementary tests."""
    upright, end = UPRIGHT.to(device), END.to(device)
    turns = torch.stack([upright, upright])
    points = torch.tensor([[[0.0, 0, 1], [-1, -1, 0], [2, -1, 0], [-1, 2, 0]]], device=device)
    below = points.clone()
    below[:, 0, 2] = -1.0
    crossing = torch.tensor([[[-1.0, 0, 1], [1, 0, 1], [0, -1, 0], [0, 1, 0]]], device=device)
    across = crossing.clone()
    across[:, :2, 2] = -1.0
    for dtype in (torch.float32, torch.float64):
        x0 = wanting(START.to(device, dtype))
        ways = wanting(torch.stack([START, END]).to(device, dtype))
        margin, gap = (wanting(torch.full(size, 0.01, device=device, dtype=torch.float64)) for size in ((2,), ()))
        motion, path = pgccd.RigidMotion(x0, upright, end, upright), pgccd.Trajectory(ways, turns)
        hits, along = pgccd.detect(scene(device), motion), pgccd.detect(scene(device), path)
        plain = pgccd.RigidMotion(START.to(device), upright, end, upright)
        wide = scene(device, margin=margin)
        thick = pgccd.detect(wide, plain)
        apart = pgccd.detect(scene(device), plain, min_separation=gap)
        of_face, of_edges = wanting(points.to(dtype)), wanting(crossing.to(dtype))
        face = pgccd.narrow.vertex_face(of_face, below.to(dtype))
        edges = pgccd.narrow.edge_edge(of_edges, across.to(dtype))
        values = [
            (each, x0)
            for each in (pgccd.approach_rates(scene(device), motion, hits), hits.first_toi(), hits.first_toi("body"))
        ]
        values += [(each, ways) for each in (along.toi, along.time, along.point, along.first_toi())]
        values += [(pgccd.approach_rates(scene(device), path, along), ways)]
        values += [
            (thick.toi, margin),
            (pgccd.approach_rates(wide, plain, thick), margin),
            (apart.toi, gap),
            (apart.point, gap),
        ]
        values += [
            (face.toi, of_face),
            (face.coordinates, of_face),
            (edges.toi, of_edges),
            (edges.coordinates, of_edges),
        ]
        for value, given in values:
            first = value[value.isfinite()].sum()
            with pytest.raises(NotImplementedError, match="has first derivatives only"):
                torch.autograd.grad(first, given, create_graph=True)


def test_transforms_of_numbers_are_refused() -> None:
    """Their tangents or samples would be lost without a word."""
    plain = pgccd.RigidMotion(START, UPRIGHT, END, UPRIGHT)
    points = torch.rand(3, 4, 3)
    calls: dict[str, Callable[[Tensor], Tensor]] = {
        "min_separation": lambda gap: pgccd.detect(scene(), plain, min_separation=gap).first_toi(),
        "tolerance": lambda gap: pgccd.detect(scene(), plain, tolerance=gap).first_toi(),  # type: ignore[call-overload]
        "dt": lambda dt: pgccd.RigidMotion.from_velocity(START, UPRIGHT, END, END, dt).position_t1,  # type: ignore[arg-type]
        "slack": lambda gap: pgccd.approaching(scene(), plain, pgccd.detect(scene(), plain), gap).toi,  # type: ignore[arg-type]
    }
    for name, call in calls.items():
        for transform in (torch.func.grad, torch.func.jacrev, torch.func.jacfwd, torch.func.hessian):
            with pytest.raises(
                TypeError, match=f"^{name}: transforms of torch.func are|^{name}: has a tangent|^{name}: torch.vmap"
            ):
                transform(lambda value, call=call: call(value).sum())(torch.tensor(0.01, dtype=torch.float64))
        with pytest.raises(TypeError, match=f"^{name}: torch.vmap is not supported"):
            torch.vmap(call)(torch.rand(3))
    with pytest.raises(TypeError, match="^min_separation: "):
        torch.func.jacfwd(lambda gap: pgccd.narrow.vertex_face(points, points, gap).toi.sum())(torch.tensor(0.01))
    with pytest.raises(ValueError, match="^slack: requires grad"):
        pgccd.approaching(scene(), plain, pgccd.detect(scene(), plain), wanting(torch.tensor(0.1)))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="^margin: requires grad"):
        pgccd.audit(scene(margin=wanting(torch.tensor([0.1, 0.1]))), [(START, UPRIGHT), (END, UPRIGHT)])


def test_transforms_are_refused() -> None:
    def toi(x0: Tensor) -> Tensor:
        motion = pgccd.RigidMotion(x0, UPRIGHT, END, UPRIGHT)
        return pgccd.detect(scene(), motion).toi.sum()

    with pytest.raises(TypeError, match="^position_t0: transforms of torch.func"):
        torch.func.grad(toi)(START)
    with pytest.raises(TypeError, match=r"^position_t0: .*tangent|^position_t0: transforms"):
        torch.func.jvp(toi, (START,), (START,))
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(START, START)
        with pytest.raises(TypeError, match="^position_t0: has a tangent"):
            toi(dual)


def test_where_no_gradient_is_computed_it_is_refused() -> None:
    wanting_motion = pgccd.RigidMotion(wanting(START), UPRIGHT, END, UPRIGHT)
    plain = pgccd.RigidMotion(START, UPRIGHT, END, UPRIGHT)
    capacity = pgccd.Capacity.of(2)
    with pytest.raises(ValueError, match="^capacity: .*requires grad"):
        pgccd.detect(scene(), wanting_motion, capacity=capacity)
    wide = scene(margin=wanting(torch.tensor([0.1, 0.1]).double()))
    with pytest.raises(ValueError, match="^capacity: .*requires grad"):
        pgccd.detect(wide, plain, capacity=capacity)
    calls: list[Callable[[pgccd.Scene, pgccd.RigidMotion], Any]] = [
        pgccd.CapturedDetection,
        pgccd.MovingBodies.of,
        pgccd.resolve,
        pgccd.enclosed,
        lambda bodies, motion: pgccd.exit_distance(bodies, motion, [1.0, 0.0, 0.0]),
    ]
    for call in calls:
        with pytest.raises(ValueError, match=r"^position_t0: requires grad.*position_t0\.detach\(\)"):
            call(scene(), wanting_motion)
        if call is not pgccd.CapturedDetection:
            with pytest.raises(ValueError, match="^margin: requires grad"):
                call(wide, plain)
    with pytest.raises(ValueError, match="^(capacity|margin): .*requires grad"):
        pgccd.CapturedDetection(wide, plain).replay()
    assert len(pgccd.collide(wide, wanting_motion)) == 1  # pairs have no derivatives
    with pytest.raises(ValueError, match="^vertices: requires grad"):
        pgccd.Mesh(wanting(meshes()[0].vertices), meshes()[0].faces)
    with pytest.raises(ValueError, match="^tolerance: requires grad"):
        pgccd.detect(scene(), plain, tolerance=wanting(torch.tensor(0.1)))  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="^fraction: requires grad"):
        plain.shortened(wanting(torch.tensor(0.5)))
    with pytest.raises(ValueError, match="^orientation: requires grad"):
        pgccd.integrate_orientation(wanting(UPRIGHT), TURN)


def test_refusals_name_what_was_passed() -> None:
    """Not the columns that are made of it."""
    velocity = torch.zeros_like(START)
    one = velocity[None]
    q = torch.stack([UPRIGHT, UPRIGHT])
    x = torch.stack([START, END])
    world = pgccd.distributed.World.create(pgccd.Scene(meshes(), [0, 1]), START, (-9.0,) * 3, (9.0,) * 3)
    motions: dict[str, Callable[[], Any]] = {
        "orientation_t1": lambda: pgccd.RigidMotion(START, UPRIGHT, END, wanting(UPRIGHT)),
        "linear_velocity": lambda: pgccd.RigidMotion.from_velocity(START, UPRIGHT, wanting(END), velocity, 0.1),
        "angular_velocity": lambda: pgccd.RigidMotion.from_velocity(START, UPRIGHT, END, wanting(velocity), 0.1),
        "rotation": lambda: pgccd.RigidMotion.from_rotation(START, UPRIGHT, END, wanting(velocity)),
    }
    calls: list[Callable[[Any], Any]] = [
        lambda motion: pgccd.resolve(scene(), motion),
        lambda motion: pgccd.enclosed(scene(), motion),
        world.step,
        lambda motion: world.step(motion, resolve=True),
    ]
    for name, make in motions.items():
        for call in (
            *calls,
            lambda motion: pgccd.CapturedDetection(scene(), motion),
            lambda motion: pgccd.distance(scene(), motion, cutoff=1.0),
        ):
            with pytest.raises(ValueError, match=rf"^{name}: requires grad.*{name}\.detach\(\)"):
                call(make())
    trajectories: dict[str, Callable[[], Any]] = {
        "position": lambda: pgccd.Trajectory(wanting(x), q),
        "orientation": lambda: pgccd.Trajectory(x, wanting(q)),
        "rotation": lambda: pgccd.Trajectory(x, q, rotation=wanting(one)),
        "margin": lambda: pgccd.Trajectory(x, q, margin=wanting(torch.zeros(1, 2))),
    }
    for name, make in trajectories.items():
        for call in (
            *calls,
            lambda motion: pgccd.audit(scene(), motion),
            lambda motion: pgccd.distance(scene(), motion, cutoff=1.0),
        ):
            with pytest.raises(ValueError, match=rf"^{name}: requires grad.*{name}\.detach\(\)"):
                call(make())
    with pytest.raises(ValueError, match="^rotation: requires grad"):
        pgccd.Trajectory(x, UPRIGHT, rotation=wanting(one))


@pytest.mark.slow
def test_compiled(device: torch.device) -> None:
    """Elementary tests as one graph; `detect` breaks it."""
    start, end = (torch.randn(300, 4, 3, dtype=torch.float64, device=device) for _ in range(2))

    def elementary(start: Tensor, end: Tensor) -> Tensor:
        found = pgccd.narrow.edge_edge(start, end)
        return torch.where(found.differentiable, found.toi, 0.0).sum()

    of_scene = scene(device)

    def of_detection(x0: Tensor, x1: Tensor) -> Tensor:
        motion = pgccd.RigidMotion.from_rotation(x0, UPRIGHT.to(device), 1.0 * x1, TURN.to(device))
        hits = pgccd.detect(of_scene, motion)
        return hits.first_toi().clamp(max=1.0) ** 2 + hits.point.sum()

    for function, inputs, whole in (
        (elementary, (start, end), True),
        (of_detection, (START.to(device), END.to(device)), False),
    ):
        compiled = torch.compile(function, backend="aot_eager", fullgraph=whole)
        results = []
        for call in (function, compiled):
            given = [wanting(x) for x in inputs]
            value = call(*given)
            results.append((value, *torch.autograd.grad(value, given)))
        for expected, found in zip(*results, strict=True):
            assert torch.allclose(found, expected, rtol=1e-12)
