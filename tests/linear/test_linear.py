"""Transposes, exact solves, convergence, derivatives of the linear layer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.fft import dctn

from jaxgeom import RESULTS
from jaxgeom.linear import (
    Multigrid,
    Nystrom,
    conjugate_gradients,
    cosine_solve,
    interpolate,
    laplacian,
    laplacian_diagonal,
    prolong,
    restrict,
    smooth,
    splat,
    splat_gradient,
)

SHAPE = (9, 6, 14)
COEFFICIENTS = np.array([0.7, 1.6, 1.1])


def _draw(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def _points(seed, n=40):
    unit = np.random.default_rng(seed).uniform(size=(n, 3))
    return jnp.asarray(0.6 + unit * (np.array(SHAPE) - 2.2))


def _matrix(operator, shape):
    basis = jnp.eye(int(np.prod(shape))).reshape(-1, *shape)
    return np.asarray(jax.vmap(operator)(basis)).reshape(len(basis), -1).T


def test_splat_is_the_transpose_of_interpolate(x64):
    u, w, q = _draw(0, *SHAPE), _draw(1, 40), _points(2)
    left = jnp.vdot(w, interpolate(u, q))
    np.testing.assert_allclose(left, jnp.vdot(splat(w, q, SHAPE), u), rtol=1e-12)


def test_interpolation_is_exact_for_trilinear_functions(x64):
    x, y, z = np.meshgrid(*map(np.arange, SHAPE), indexing="ij")
    f = lambda x, y, z: 1 + 2 * x - y + 0.5 * z + x * y * z
    q = _points(3)
    np.testing.assert_allclose(interpolate(jnp.asarray(f(x, y, z)), q), f(*q.T))


def test_splat_gradient_is_the_derivative_of_a_smooth_splat(x64):
    """Moments of grad K: sum 0, first moment the vector, as for any kernel gradient."""
    vectors, q = _draw(4, 40, 3), _points(5)
    b = splat_gradient(vectors, q, SHAPE)
    nodes = jnp.stack(jnp.meshgrid(*map(jnp.arange, SHAPE), indexing="ij"), -1)
    np.testing.assert_allclose(b.sum(), 0, atol=1e-12)
    first = jnp.einsum("xyz,xyzd->d", b, nodes)
    np.testing.assert_allclose(first, vectors.sum(axis=0), atol=1e-11)


@pytest.mark.parametrize("shape", [(8, 8, 8), (9, 6, 14), (5, 7, 3)])
def test_restrict_is_the_transpose_of_prolong(shape, x64):
    coarse = tuple(-(-n // 2) for n in shape)
    p = _matrix(lambda u: prolong(u, shape), coarse)
    np.testing.assert_allclose(_matrix(restrict, shape), p.T, atol=1e-15)
    np.testing.assert_allclose(p.sum(axis=1), 1)


def test_prolong_reproduces_linear_functions_inside(x64):
    u = jnp.broadcast_to(2.0 * jnp.arange(7)[:, None, None] + 0.5, (7, 4, 4))
    fine = prolong(u, (14, 8, 8))
    np.testing.assert_allclose(fine[1:-1, 0, 0], np.arange(1, 13), atol=1e-14)


def test_laplacian_is_symmetric_semidefinite_with_constants_as_kernel(x64):
    shape = (4, 5, 3)
    matrix = _matrix(lambda u: laplacian(u, COEFFICIENTS), shape)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14)
    eigenvalues = np.linalg.eigvalsh(matrix)
    assert abs(eigenvalues[0]) < 1e-12 < eigenvalues[1]
    np.testing.assert_allclose(matrix.sum(axis=1), 0, atol=1e-13)
    diagonal = laplacian_diagonal(shape, jnp.asarray(COEFFICIENTS))
    np.testing.assert_allclose(np.diag(matrix), diagonal.reshape(-1))


def test_smooth_keeps_sums(x64):
    u = _draw(6, *SHAPE)
    np.testing.assert_allclose(smooth(u).sum(), u.sum(), rtol=1e-12)


def test_cosine_solve_inverts_the_laplacian(x64):
    b = _draw(7, *SHAPE)
    b = b - b.mean()
    c = jnp.asarray(COEFFICIENTS)
    u = cosine_solve(b, c)
    np.testing.assert_allclose(laplacian(u, c), b, atol=1e-12)
    np.testing.assert_allclose(u.mean(), 0, atol=1e-14)
    shifted = cosine_solve(b, c, 0.3)
    np.testing.assert_allclose(laplacian(shifted, c) + 0.3 * shifted, b, atol=1e-12)


def test_cosine_basis_is_that_of_scipy(x64):
    from jaxgeom.linear import CosineTransform

    u = _draw(8, *SHAPE)
    bases = CosineTransform.of(SHAPE, jnp.asarray(COEFFICIENTS)).bases
    ours = jnp.einsum("ax,by,cz,xyz->abc", *bases, u)
    np.testing.assert_allclose(ours, dctn(np.asarray(u), norm="ortho"), atol=1e-12)


def _screened(n, seed, strength, dtype):
    shape = (n, n - 3, n + 5)
    points = np.random.default_rng(seed).normal(size=(3 * n * n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    q = jnp.asarray((points * 0.35 + 0.5) * np.array(shape), dtype)
    pull = jnp.full(len(points), strength, dtype)
    c = jnp.asarray(COEFFICIENTS, dtype)
    operator = lambda u: laplacian(u, c) + splat(pull * interpolate(u, q), q, shape)
    return shape, operator, splat(pull, q, shape), c


def test_v_cycle_is_symmetric_positive(x64):
    shape, _, diagonal, c = _screened(20, 0, 2.0, jnp.float64)
    multigrid = Multigrid.of(diagonal, c)
    a, b = _draw(9, *shape), _draw(10, *shape)
    left, right = jnp.vdot(multigrid.v_cycle(a), b), jnp.vdot(a, multigrid.v_cycle(b))
    np.testing.assert_allclose(left, right, rtol=1e-10)
    assert jnp.vdot(a, multigrid.v_cycle(a)) > 0


@pytest.mark.parametrize("strength", [0.3, 4.0, 30.0])
def test_multigrid_needs_few_steps_at_every_size(strength):
    """Also the float32 breakdown case: 32^3 to 64^3 nodes, true residual 1e-5."""
    steps = []
    for n in (32, 64):
        shape, operator, diagonal, c = _screened(n, 1, strength, jnp.float32)
        b = _draw(11, *shape).astype(jnp.float32)
        multigrid = Multigrid.of(diagonal, c)
        solve = jax.jit(
            lambda b, o=operator, m=multigrid: conjugate_gradients(
                o, b, rtol=1e-5, max_steps=60, preconditioner=m.v_cycle, start=m.full
            )
        )
        out = solve(b)
        assert out.result == RESULTS.successful
        true = jnp.linalg.norm(b - operator(out.value)) / jnp.linalg.norm(b)
        assert true <= 1.01e-5
        steps.append(int(out.steps))
    assert steps[1] <= 1.5 * steps[0] + 2 and max(steps) < 40


def test_stopped_early_is_a_status_with_the_true_residual():
    shape, operator, _, _ = _screened(16, 2, 4.0, jnp.float32)
    b = _draw(12, *shape).astype(jnp.float32)
    out = conjugate_gradients(operator, b, rtol=1e-6, max_steps=3)
    assert out.result == RESULTS.not_converged and int(out.steps) == 3
    true = jnp.linalg.norm(b - operator(out.value)) / jnp.linalg.norm(b)
    np.testing.assert_allclose(out.residual, true, rtol=1e-4)


def test_the_true_residual_arrives_and_not_only_the_recursive_one():
    """In single precision the two drift apart, which must not look like a failure."""
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.normal(size=(120, 120)))
    a = jnp.asarray(basis * np.geomspace(1, 3e4, 120) @ basis.T, jnp.float32)
    sides = jnp.asarray(rng.normal(size=(24, 120)), jnp.float32)
    run = lambda b, rtol: conjugate_gradients(
        lambda x: a @ x, b, rtol=rtol, max_steps=5000
    )
    found = jax.jit(jax.vmap(lambda b: run(b, 2e-3)))(sides)
    assert np.all(found.residual <= 2e-3)
    gap = np.linalg.norm(sides - found.value @ a, axis=1)
    assert np.all(gap <= 2.2e-3 * np.linalg.norm(sides, axis=1))
    # What rounding does not allow ends all the same, long before the last step.
    never = jax.jit(lambda b: run(b, 1e-9))(sides[0])
    assert never.result == RESULTS.not_converged and int(never.steps) < 4000


def test_zero_right_side_gives_zero():
    shape, operator, _, _ = _screened(16, 3, 4.0, jnp.float32)
    out = conjugate_gradients(operator, jnp.zeros(shape), rtol=1e-5, max_steps=9)
    assert out.result == RESULTS.successful and int(out.steps) == 0
    assert (out.value == 0).all()


def test_derivative_of_a_solution_is_central_difference(x64):
    b, d = _draw(13, 5, 4, 6), jnp.abs(_draw(14, 5, 4, 6)) + 0.2
    w, wb, wd = _draw(15, 5, 4, 6), _draw(16, 5, 4, 6), _draw(17, 5, 4, 6) * 0.1

    def loss(t):
        diagonal = d + t * wd
        operator = lambda u: laplacian(u, COEFFICIENTS) + diagonal * u
        out = conjugate_gradients(operator, b + t * wb, rtol=1e-13, max_steps=300)
        return jnp.vdot(w, out.value)

    central = (loss(1e-5) - loss(-1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(loss)(0.0), central, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(loss, (0.0,), (1.0,))[1], central, rtol=1e-7)


def test_batch_equals_loop():
    shape, operator, _, _ = _screened(12, 4, 4.0, jnp.float32)
    b = _draw(18, 3, *shape).astype(jnp.float32)
    solve = lambda b: conjugate_gradients(operator, b, rtol=1e-5, max_steps=200)
    together = jax.vmap(solve)(b)
    for i in range(3):
        single = solve(b[i])
        np.testing.assert_allclose(together.value[i], single.value, atol=1e-4)
        assert int(together.steps[i]) == int(single.steps)


def test_largest_eigenvalues_make_a_preconditioner(x64):
    """Against dense algebra, for a spectrum of halves."""
    shape, rank = (3, 20), 12
    axes = np.linalg.qr(np.asarray(_draw(19, 60, 60)))[0]
    a = jnp.asarray(axes * (1e5 * 0.5 ** np.arange(60)) @ axes.T)
    operator = lambda x: (a @ x.reshape(-1)).reshape(shape)
    found = jax.jit(lambda t: Nystrom.of(operator, t))(_draw(20, rank, *shape))
    flat = found.vectors.reshape(rank, -1)
    np.testing.assert_allclose(flat @ flat.T, np.eye(rank), atol=1e-9)
    dense = np.eye(60) + (flat.T * (found.factors - 1)) @ flat
    x = _draw(21, *shape)
    np.testing.assert_allclose(found(x).reshape(-1), dense @ x.reshape(-1), rtol=1e-9)
    system = np.eye(60) + np.asarray(a)
    spread = lambda m: np.ptp(np.log10(np.linalg.eigvals(m @ system).real))
    # Exact for the eigenvalues found but for what the random vectors missed.
    assert spread(np.eye(60)) > 4.5 and spread(dense) < 0.5 * spread(np.eye(60))
    whole = Nystrom.of(operator, _draw(22, 60, *shape))
    solve = lambda p: conjugate_gradients(
        lambda x: operator(x) + x, x, rtol=1e-8, max_steps=500, preconditioner=p
    )
    plain, some, all_ = (int(solve(p).steps) for p in (lambda r: r, found, whole))
    assert all_ <= 2 < some < 0.7 * plain
    nothing = Nystrom.of(lambda x: 0 * x, _draw(23, 4, *shape))
    np.testing.assert_allclose(nothing(x), x, atol=1e-12)
