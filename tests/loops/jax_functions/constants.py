"""Functions in which constants and parameters are computed, in every precision."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

F16, B16, F32 = jnp.float16, jnp.bfloat16, jnp.float32
KINDS = {"float16": F16, "bfloat16": B16, "float32": F32, "float64": jnp.float64}
RNG = np.random.default_rng(5)
D = RNG.normal(size=30)
C = 1e3 + RNG.normal(size=30)
M = RNG.normal(size=(4, 4))
S = M @ M.T + np.eye(4)

REDUCTIONS = {
    "sum": jnp.sum,
    "prod": lambda d: jnp.prod(d[:9]),
    "max": jnp.max,
    "min": jnp.min,
    "mean": jnp.mean,
    "var": jnp.var,
    "std": jnp.std,
    "norm": jnp.linalg.norm,
    "cumsum": lambda d: jnp.cumsum(d)[-2:],
    "dot": lambda d: d @ d[::-1],
    "logsumexp": jax.nn.logsumexp,
    "softmax": lambda d: jax.nn.softmax(d)[:2] * 10,
}


def of_constants(reduction, kind):
    return lambda x: x * reduction(jnp.asarray(D, kind))


def of_parameters(reduction, kind):
    return Partial(lambda d, x: x * reduction(d), jnp.asarray(D, kind))


REDUCED_CONSTANTS = [of_constants(r, kind) for r in REDUCTIONS.values() for kind in KINDS.values()]
REDUCED_PARAMETERS = [
    of_parameters(r, kind) for r in REDUCTIONS.values() for kind in KINDS.values()
]

CASTS = [
    lambda x: x.astype(float),
    lambda x: lax.convert_element_type(x, jnp.float64),
    lambda x: x * jnp.float32(0.1),
    lambda x: x * jnp.float16(0.1),
    lambda x: x * jnp.bfloat16(0.1),
    lambda x: x * jnp.asarray(0.1, F32).astype(F16),
    lambda x: x + jnp.asarray(D[:2], F16),
    lambda x: x * jnp.asarray(D[:2]).astype(int),
    lambda x: x * jnp.asarray(300.7).astype(jnp.int16),
    lambda x: x * jnp.asarray(200).astype(jnp.int8),
    lambda x: x * jnp.asarray(-1).astype(jnp.uint8),
    lambda x: x * jnp.asarray(2**24 + 1).astype(F32),
    lambda x: x * (jnp.arange(2) > 0),
    lambda x: x + (jnp.arange(2) > 0).astype(F32) * jnp.float32(0.1),
    lambda x: x * jnp.asarray([True, False]).astype(int),
    lambda x: jnp.where(jnp.array([True, False]), x, jnp.float16(0.1)),
    lambda x: x * jnp.asarray(0.1, F32) * jnp.asarray(3.0, F16),
    lambda x: x * (jnp.asarray(0.1, F32) * jnp.asarray(3.0, F16)),
    lambda x: x * (jnp.asarray(0.1, F32) / 3),
    lambda x: x * (jnp.asarray(7) // 2) + jnp.asarray(7) % 4,
    lambda x: x * (jnp.asarray(7) / 2),
    lambda x: x * jnp.bitwise_and(jnp.asarray(6), 3),
    lambda x: x * lax.bitcast_convert_type(jnp.float32(1.5), jnp.int32) * 1e-9,
    lambda x: x * jnp.round(jnp.asarray(D[:2], F32), 2),
    lambda x: x * jnp.finfo(F32).eps,
    lambda x: x * jnp.asarray(1e-320),
    lambda x: x * jnp.float32(1e-42),
    lambda x: x * jnp.asarray(5e-8, F16),
    lambda x: x + jnp.linspace(0, 1, 7, dtype=F32)[2:4],
    lambda x: x + jnp.arange(0, 1, 0.1, dtype=F32)[3:5],
    lambda x: x * jnp.abs(jnp.asarray(3 + 4j)),
]

MATRICES = [
    lambda x: jnp.linalg.inv(jnp.asarray(M))[:2, :2] @ x,
    lambda x: jnp.linalg.inv(jnp.asarray(M, F32))[:2, :2] @ x,
    lambda x: x * jnp.linalg.det(jnp.asarray(M)),
    lambda x: x * jnp.linalg.slogdet(jnp.asarray(S))[1],
    lambda x: x + jnp.linalg.solve(jnp.asarray(M), jnp.ones(4))[:2],
    lambda x: jax.scipy.linalg.expm(jnp.asarray(M))[:2, :2] @ x,
    lambda x: jnp.linalg.svd(jnp.asarray(M))[1][:2] * x,
    lambda x: jnp.linalg.qr(jnp.asarray(M))[1][:2, :2] @ x,
    lambda x: jnp.linalg.eigh(jnp.asarray(S))[0][:2] * x,
    lambda x: jnp.linalg.eigvalsh(jnp.asarray(S, F32))[:2] * x,
    lambda x: jnp.linalg.cholesky(jnp.asarray(S))[:2, :2] @ x,
    lambda x: jnp.linalg.cholesky(jnp.asarray(S, F32))[:2, :2] @ x,
    lambda x: jax.scipy.linalg.solve_triangular(jnp.asarray(S), jnp.ones(4))[:2] * x,
    lambda x: (
        jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(jnp.asarray(S[:2, :2])), jnp.ones(2))
        * x
    ),
    lambda x: jnp.linalg.pinv(jnp.asarray(M[:, :2]))[:, :2] @ x,
    lambda x: jnp.linalg.lstsq(jnp.asarray(M[:, :2]), jnp.ones(4))[0] * x,
    lambda x: jnp.linalg.matrix_power(jnp.asarray(M), 5)[:2, :2] @ x,
    lambda x: jnp.linalg.norm(jnp.asarray(M), 2) * x,
    lambda x: jnp.linalg.cond(jnp.asarray(S)) * x,
    lambda x: jnp.linalg.matrix_rank(jnp.asarray(S)) * x,
    lambda x: (jnp.asarray(M, F32) @ jnp.asarray(M, F32))[:2, :2] @ x,
    lambda x: (jnp.asarray(M, B16) @ jnp.asarray(M, B16))[:2, :2] @ x,
    lambda x: jnp.dot(jnp.asarray(D, F16), jnp.asarray(C, F16)) * x,
    Partial(lambda M, x: jnp.linalg.inv(M)[:2, :2] @ x, jnp.asarray(M)),
    Partial(lambda M, x: jax.scipy.linalg.expm(M)[:2, :2] @ x, jnp.asarray(M)),
    Partial(lambda M, x: jnp.linalg.solve(M, jnp.ones(4))[:2] * x, jnp.asarray(M)),
    Partial(lambda M, x: jnp.linalg.svd(M)[1][:2] * x, jnp.asarray(M)),
    Partial(lambda M, x: jnp.linalg.qr(M)[1][:2, :2] @ x, jnp.asarray(M)),
    Partial(lambda M, x: jnp.linalg.cholesky(M @ M.T)[:2, :2] @ x, jnp.asarray(M)),
    lambda x: jnp.linalg.solve(jnp.asarray(M[:2, :2]), x),
]

CLOSURES = [
    lambda x: x * 3,
    lambda x: x * 0.1,
    lambda x: x * np.float32(0.1),
    lambda x: x * np.float64(0.1),
    lambda x: x * np.array([0.1, 0.2]),
    lambda x: x * np.array([0.1, 0.2], np.float32),
    lambda x: x * np.array([1, 2]),
    lambda x: x * np.array([True, False]),
    lambda x: x * float(Fraction(1, 3)),
    lambda x: x * np.sin(0.3),
    lambda x: x * jnp.sin(0.3),
    lambda x: x * jnp.sin(jnp.float32(0.3)),
    lambda x: x * np.sum(np.full(1000, 0.1, np.float32)),
    lambda x: x * sum(np.float16(0.1) for _ in range(5)),
    lambda x: x * jnp.pi + jnp.e,
    lambda x: x * (jnp.sqrt(2.0) - 1.4142135623730951),
    lambda x: x * (jnp.mean(jnp.asarray(C) ** 2) - jnp.mean(jnp.asarray(C)) ** 2),
    lambda x: x * jnp.sum(jnp.array([1e8, 1.0, -1e8], F32)),
    lambda x: x * jnp.sum(jnp.array([1e16, 1.0, -1e16])),
    lambda x: x * jnp.exp(jnp.log(jnp.asarray(3.0, F32))),
    lambda x: x * jnp.asarray(1e300) * 1e-300,
    lambda x: x * (jnp.asarray(1e-200) * 1e200),
    lambda x: x * jnp.nan_to_num(jnp.nan),
    lambda x: jnp.minimum(x, jnp.inf),
    lambda x: jnp.clip(x, -jnp.inf, 0.3),
    Partial(lambda p, x: p * x, 0.1),
    Partial(lambda p, x: p * x, jnp.float32(0.1)),
    Partial(lambda p, x: p * x, np.float16(0.1)),
    Partial(lambda p, x: x * p["a"] + p["b"], {"a": jnp.asarray(0.1, F32), "b": np.ones(2)}),
    Partial(lambda p, x: x * jnp.sin(p), jnp.asarray(0.3)),
    Partial(lambda p, x: x * jnp.sin(p), jnp.asarray(0.3, F32)),
    Partial(lambda p, x: x * (p * jnp.float32(0.1)), jnp.asarray(0.3, F32)),
    Partial(lambda p, x: x * jnp.tanh(p) ** 3 / (1 + p), jnp.asarray(D[:2])),
    Partial(lambda p, x: jax.nn.relu(p) * x, jnp.asarray(D[:2])),
    Partial(lambda p, n, x: p * x * n, jnp.asarray(0.3), 3),
    Partial(lambda p, x: x[p], jnp.array([1, 0])),
    Partial(lambda p, x: jnp.where(p > 0, x, 2 * x), jnp.asarray(D[:2])),
    Partial(lambda p, x: x * (jnp.mean(p**2) - jnp.mean(p) ** 2), jnp.asarray(C)),
]

REFUSED = [
    lambda x: x.astype(F32),
    lambda x: x.astype(F32).astype(float),
    lambda x: x.astype(B16) * 1.0,
    lambda x: x.astype(int) * 1.0,
    lambda x: x.astype(bool) * 1.0,
    lambda x: lax.reduce_precision(x, 8, 7),
    lambda x: (x > 0.1) * x,
    lambda x: (x > 0.1).astype(float) * 2,
    lambda x: (x > 0.1).astype(float) * (x - 0.1),
    lambda x: x + jnp.inf * 0,
    lambda x: x / 0.0,
    Partial(lambda p, x: lax.cond(p > 0, lambda: x, lambda: 2 * x), jnp.asarray(0.3)),
]
"""What has no bounds, or not yet."""

FAMILIES = {
    "reduced constants": REDUCED_CONSTANTS,
    "reduced parameters": REDUCED_PARAMETERS,
    "casts": CASTS,
    "matrices": MATRICES,
    "closures": CLOSURES,
}
