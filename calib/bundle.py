"""Bundle adjustment of a flat board seen by one or two cameras: lenses, board poses, and the rigid step between arms.

Least squares by Levenberg-Marquardt in float64, the board poses eliminated view by view (Schur complement), so that
the normal matrix of the shared parameters, and with it their covariance, falls out exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from spikerig.calib.lens import COEFFICIENTS, bend, bent_only, by_coefficients, stored
from spikerig.dataset.errors import NumericsError
from spikerig.dataset.scene import Camera

Floats = NDArray[np.float64]
STAY = np.eye(4)[:3]
SHORTEST, LONGEST = 0.1, 100.0  # focal lengths in picture widths: 157 to 0.6 degrees across


@dataclass(frozen=True, slots=True)
class Sight:
    """What one camera saw of the board, view by view.

    Args:
        px: float64[V,N,2] pixels (centres at +0.5) of the board's N corners; anything where not seen.
        seen: bool[V,N].
        width, height: of the picture.
        sigma_px: standard deviation of a coordinate, the weight of this camera in a joint fit.
    """

    px: Floats
    seen: NDArray[np.bool_]
    width: int
    height: int
    sigma_px: float = 1.0

    @property
    def views(self) -> NDArray[np.bool_]:
        """bool[V]: where any of the board was seen."""
        return np.asarray(self.seen.any(axis=1))

    def flipped(self) -> Sight:
        """The same picture seen in a mirror (left and right swapped)."""
        return replace(self, px=np.stack([self.width - self.px[..., 0], self.px[..., 1]], -1))


@dataclass(frozen=True, slots=True)
class Guess:
    """Where a fit starts: lenses (K, coefficients), poses first_from_board [V,3,4], step second_from_first [3,4]."""

    lenses: tuple[tuple[Floats, Floats], ...]
    poses: Floats
    step: Floats = field(default_factory=lambda: STAY)


@dataclass(frozen=True, slots=True)
class Fit:
    """A solved bundle.

    Args:
        lenses, poses, step: as in `Guess`.
        off_px: per camera float64[V,N,2], found minus predicted; 0 where not seen or not used.
        cov: float64[P,P] covariance of the shared parameters `names`, scaled by the residual.
        names: e.g. "fx0", "k1_1" (camera number last), "turn_x", "shift_z" of the step between cameras.
        used: per camera bool[V,N], the corners that counted.
        chi2: weighted sum of squares, with `dof` degrees of freedom.
        converged: whether the fit came to rest.
    """

    lenses: tuple[tuple[Floats, Floats], ...]
    poses: Floats
    step: Floats
    off_px: tuple[Floats, ...]
    used: tuple[NDArray[np.bool_], ...]
    cov: Floats
    names: tuple[str, ...]
    chi2: float
    dof: int
    converged: bool

    def camera(self, number: int, sight: Sight) -> Camera:
        """The fitted camera."""
        K, coefficients = self.lenses[number]
        return Camera(K, stored(coefficients), sight.width, sight.height)

    def rms_px(self, number: int | None = None) -> float:
        """Root mean square distance of found and predicted corners (as OpenCV counts it), of one camera or of all."""
        chosen = range(len(self.off_px)) if number is None else [number]
        total = sum(float((self.off_px[k] ** 2).sum()) for k in chosen)
        return float(np.sqrt(total / max(sum(int(self.used[k].sum()) for k in chosen), 1)))

    def view_rms_px(self, number: int) -> Floats:
        """The same for each view, float64[V]; NaN where the view has no corner."""
        n = self.used[number].sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.sqrt((self.off_px[number] ** 2).sum((1, 2)) / n)

    def sd(self, name: str) -> float:
        """Standard deviation of a shared parameter; 0 where it was held."""
        if name not in self.names:
            return 0.0
        k = self.names.index(name)
        return float(np.sqrt(max(self.cov[k, k], 0)))


def turn(w: Floats) -> Floats:
    """Rotation matrices float64[...,3,3] of rotation vectors float64[...,3] (Rodrigues)."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < 1e-8
    safe = np.where(small, 1, angle)
    cross = cross_matrix(w)
    a = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * cross + b * (cross @ cross)


def cross_matrix(v: Floats) -> Floats:
    """float64[...,3,3] with cross_matrix(v) @ u = v x u."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)


@dataclass(slots=True)
class _Problem:
    board: Floats
    sights: tuple[Sight, ...]
    use: NDArray[np.bool_]
    free_lens: bool
    free_turn: bool
    free_shift: bool

    def names(self, lenses: tuple[tuple[Floats, Floats], ...]) -> tuple[str, ...]:
        found: list[str] = []
        if self.free_lens:
            for k, (_, c) in enumerate(lenses):
                found += [f"{n}{k}" for n in ("fx", "fy", "cx", "cy")] + [f"{n}_{k}" for n in COEFFICIENTS[: len(c)]]
        if len(lenses) == 2:
            found += ["turn_x", "turn_y", "turn_z"] if self.free_turn else []
            found += ["shift_x", "shift_y", "shift_z"] if self.free_shift else []
        return tuple(found)

    def residuals(self, state: Guess) -> tuple[list[Floats], list[tuple[Floats, Floats]]]:
        """Per camera: found minus predicted [V,N,2], and (points of the board, turned points) for the derivatives."""
        off, points = [], []
        for k, sight in enumerate(self.sights):
            turned = self.board @ state.poses[:, :, :3].transpose(0, 2, 1)  # [V,N,3]
            p = turned + state.poses[:, None, :, 3]
            if k:
                p = p @ state.step[:, :3].T + state.step[:, 3]
            K, c = state.lenses[k]
            z = np.where(np.abs(p[..., 2:]) < 1e-9, 1e-9, p[..., 2:])
            px = bent_only(p[..., :2] / z, c) * np.diag(K)[:2] + K[:2, 2]
            use = sight.seen & self.use[:, None]
            off.append(np.where(use[..., None] & np.isfinite(px), sight.px - px, 0.0) / sight.sigma_px)
            points.append((turned, p))
        return off, points

    def normal(self, state: Guess) -> tuple[Floats, Floats, Floats, Floats, Floats, float]:
        """A [P,P], B [V,P,6], C [V,6,6], a [P], c [V,6] of the normal equations, and the cost."""
        off, points = self.residuals(state)
        names = self.names(state.lenses)
        V, P = len(state.poses), len(names)
        A, B, C = np.zeros((P, P)), np.zeros((V, P, 6)), np.zeros((V, 6, 6))
        a, c = np.zeros(P), np.zeros((V, 6))
        for k, sight in enumerate(self.sights):
            turned, p = points[k]
            shared, pose = self._derivatives(k, state, turned, p, names)
            use = (sight.seen & self.use[:, None])[..., None, None] / sight.sigma_px
            r = off[k].reshape(V, -1)
            shared, pose = (shared * use).reshape(V, r.shape[1], P), (pose * use).reshape(V, r.shape[1], 6)
            A += np.einsum("vni,vnj->ij", shared, shared, optimize=True)
            B += shared.transpose(0, 2, 1) @ pose
            C += pose.transpose(0, 2, 1) @ pose
            a += np.einsum("vni,vn->i", shared, r)
            c += np.einsum("vni,vn->vi", pose, r)
        return A, B, C, a, c, float(sum((o**2).sum() for o in off))

    def _derivatives(
        self, k: int, state: Guess, turned: Floats, p: Floats, names: tuple[str, ...]
    ) -> tuple[Floats, Floats]:
        """d pixel / d shared parameters [V,N,2,P] and / d pose [V,N,2,6]."""
        K, coefficients = state.lenses[k]
        z = np.where(np.abs(p[..., 2]) < 1e-9, 1e-9, p[..., 2])
        xy = p[..., :2] / z[..., None]
        bent, by_xy = bend(xy, coefficients)
        f = np.diag(K)[:2]
        flat = np.zeros((*z.shape, 2, 3))
        flat[..., 0, 0] = flat[..., 1, 1] = 1 / z
        flat[..., 2] = -xy / z[..., None]
        by_p = (f[:, None] * by_xy) @ flat
        shared = np.zeros((*z.shape, 2, len(names)))
        if self.free_lens:
            at = names.index(f"fx{k}")
            shared[..., 0, at], shared[..., 1, at + 1] = bent[..., 0], bent[..., 1]
            shared[..., 0, at + 2] = shared[..., 1, at + 3] = 1
            shared[..., at + 4 : at + 4 + len(coefficients)] = f[:, None] * by_coefficients(xy, coefficients)
        by_turn = -cross_matrix(turned)
        by_first = by_p
        if k:
            if self.free_turn:
                at = names.index("turn_x")
                shared[..., at : at + 3] = by_p @ -cross_matrix(p - state.step[:, 3])
            if self.free_shift:
                at = names.index("shift_x")
                shared[..., at : at + 3] = by_p
            by_first = by_p @ state.step[:, :3]
        return shared, np.concatenate([by_first @ by_turn, by_first], -1)

    def moved(self, state: Guess, shared: Floats, poses: Floats) -> Guess:
        """The state after a step of the solver."""
        lenses, at = [], 0
        for K, coefficients in state.lenses:
            if self.free_lens:
                n = len(coefficients)
                d = shared[at : at + 4 + n]
                K = K + np.array([[d[0], 0, d[2]], [0, d[1], d[3]], [0, 0, 0]])
                coefficients, at = coefficients + d[4:], at + 4 + n
            lenses.append((K, coefficients))
        step = state.step
        if len(self.sights) == 2:
            w = shared[at : at + 3] if self.free_turn else np.zeros(3)
            shift = shared[len(shared) - 3 :] if self.free_shift else np.zeros(3)
            step = np.concatenate([turn(w) @ step[:, :3], (step[:, 3] + shift)[:, None]], 1)
        R = turn(poses[:, :3]) @ state.poses[:, :, :3]
        return Guess(tuple(lenses), np.concatenate([R, (state.poses[:, :, 3] + poses[:, 3:])[..., None]], 2), step)


def solve(
    board: Floats,
    sights: tuple[Sight, ...],
    guess: Guess,
    *,
    use: NDArray[np.bool_] | None = None,
    free_lens: bool = True,
    free_turn: bool = True,
    free_shift: bool = True,
    most: int = 60,
    rest: float = 1e-10,
) -> Fit:
    """Fit lenses, board poses and the step between two cameras.

    Args:
        board: float64[N,3] corners of the board.
        sights: one or two cameras.
        guess: where to start; its numbers of lens coefficients are the fit's.
        use: bool[V], views that count; default all.
        free_lens: fit the lenses, or hold them as guessed.
        free_turn, free_shift: of two cameras: fit the rotation and the shift between them, or hold them.
        most: steps of the solver, which stops once a step gains less than `rest` of the cost.

    Returns:
        A Fit. A board pose that no used corner sees stays as guessed.

    Raises:
        NumericsError: the guess is not finite.

    Edges:
        A direction that the views say nothing about gets a huge variance, not an exception.

    Cost:
        About 2 ms a step for 20 views of 54 corners.
    """
    use = np.ones(len(guess.poses), bool) if use is None else use
    problem = _Problem(board, sights, use, free_lens, free_turn, free_shift)
    state, damping = guess, 1e-4
    A, B, C, a, c, cost = problem.normal(state)
    if not np.isfinite(cost):
        raise NumericsError("the start of a fit is not finite", value=cost)
    converged = False
    for _ in range(most):
        shared, poses = _step(A, B, C, a, c, damping)
        trial = problem.moved(state, shared, poses)
        trial_cost = float(sum((o**2).sum() for o in problem.residuals(trial)[0])) if _sane(problem, trial) else np.inf
        if trial_cost <= cost:
            gain = cost - trial_cost
            state, damping = trial, max(damping / 10, 1e-12)
            A, B, C, a, c, cost = problem.normal(state)
            if gain <= rest * cost + 1e-16:
                converged = True
                break
        else:
            damping *= 10
            if damping > 1e8:
                converged = True
                break
    return _told(problem, state, A, B, C, cost, converged)


def _sane(problem: _Problem, state: Guess) -> bool:
    """Whether lenses are still lenses: boards that say nothing about the focal length let it run to 0 or away."""
    ok = bool(np.isfinite(state.poses).all() and np.isfinite(state.step).all())
    for (K, c), sight in zip(state.lenses, problem.sights, strict=True):
        size = np.array([sight.width, sight.height])
        f, middle = np.diag(K)[:2] / sight.width, K[:2, 2] / size
        ok &= bool(np.all((f > SHORTEST) & (f < LONGEST)) and np.all(np.abs(middle - 0.5) < 1) and np.all(abs(c) < 1e4))
    return ok


def _step(A: Floats, B: Floats, C: Floats, a: Floats, c: Floats, damping: float) -> tuple[Floats, Floats]:
    """The damped step of the shared parameters and of the poses."""
    diagonal = np.einsum("vii->vi", C)
    damped = C + (damping * np.maximum(diagonal, 1e-12) + 1e-12)[:, :, None] * np.eye(6)
    inner = np.linalg.solve(damped, np.concatenate([B.transpose(0, 2, 1), c[:, :, None]], 2))  # C^-1 [B^T | c]
    if len(A) == 0:
        return np.zeros(0), inner[:, :, -1]
    S = A - np.einsum("vpi,viq->pq", B, inner[:, :, :-1])
    S += np.diag(damping * np.maximum(np.diag(A), 1e-12))
    right = a - np.einsum("vpi,vi->p", B, inner[:, :, -1])
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    shared = scale * np.linalg.lstsq(S * scale[:, None] * scale, right * scale, rcond=1e-15)[0]
    return shared, inner[:, :, -1] - inner[:, :, :-1] @ shared


def _told(problem: _Problem, state: Guess, A: Floats, B: Floats, C: Floats, cost: float, converged: bool) -> Fit:
    off, _ = problem.residuals(state)
    used = tuple(s.seen & problem.use[:, None] for s in problem.sights)
    names = problem.names(state.lenses)
    views = int(np.any([u.any(axis=1) for u in used], axis=0).sum())
    dof = max(2 * sum(int(u.sum()) for u in used) - len(names) - 6 * views, 1)
    empty = np.einsum("vii->v", C) == 0
    inner = np.linalg.solve(C + (empty[:, None, None] + 1e-12) * np.eye(6), B.transpose(0, 2, 1))
    S = A - np.einsum("vpi,viq->pq", B, inner)
    scale = 1 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    values, vectors = np.linalg.eigh(S * scale[:, None] * scale)
    values = np.maximum(values, 1e-14)
    cov = (vectors / values) @ vectors.T * scale[:, None] * scale * (cost / dof)
    off = tuple(o * s.sigma_px for o, s in zip(off, problem.sights, strict=True))
    return Fit(state.lenses, state.poses, state.step, off, used, cov, names, cost, dof, converged)
