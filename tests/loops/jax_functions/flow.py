"""Functions with loops, choices, calls and layers."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import lax
from jax.tree_util import Partial

F32 = jnp.float32
A = jnp.array([[0.7, -0.1], [0.2, 0.6]])
W = jnp.asarray(np.random.default_rng(7).normal(size=(3, 2, 2)))
MASKS = jnp.array([True, False, True])


def counted(limit, step, x):
    """A step, so many times."""
    return lax.while_loop(lambda c: c[0] < limit, lambda c: (c[0] + 1, step(c[1])), (0, x))[1]


def leaky(mask, y):
    """A leaky rectifier, by a mask."""
    return jnp.where(mask, y, 0.1 * y)


def first_of(numbers, x):
    """Zero, or an entry, by the place of the first of the largest of numbers, which agree."""
    parts = [jnp.stack([jnp.asarray(each)]).astype(int) for each in numbers]
    branches = [lambda y: 0 * y[0], lambda y: y[0], lambda y: 0 * y[0]]
    return lax.switch(jnp.argmax(jnp.concatenate(parts)), branches, x)


LOOPS = [
    lambda x: lax.fori_loop(0, 3, lambda k, y: A @ y, x),
    lambda x: lax.fori_loop(0, 3, lambda k, y: y * (k + 1), x),
    lambda x: lax.fori_loop(0, 3, lambda k, y: y.at[k % 2].add(0.1), x),
    lambda x: lax.fori_loop(0, 2, lambda k, y: W[k] @ y, x),
    lambda x: lax.fori_loop(jnp.int32(1), jnp.int32(3), lambda k, y: y + k, x),
    lambda x: counted(3, lambda y: A @ y, x),
    lambda x: counted(2, lambda y: jnp.tanh(A @ y), x),
    lambda x: counted(0, jnp.sin, x),
    lambda x: lax.while_loop(lambda c: c[0] > 0.3, lambda c: (c[0] / 2, A @ c[1]), (1.0, x))[1],
    lambda x: lax.while_loop(
        lambda c: c[0] > F32(0.3), lambda c: (c[0] * F32(0.9), A @ c[1]), (F32(1), x)
    )[1],
    lambda x: lax.scan(lambda c, w: (w @ c, None), x, W)[0],
    lambda x: lax.scan(lambda c, w: (c + w, c * w), x, jnp.arange(3.0))[1][-1],
    lambda x: lax.scan(lambda c, w: (c + w, c * w), x, jnp.arange(3.0), reverse=True)[0],
    lambda x: lax.scan(lambda c, y: (c + y, c), 0.0, x)[1],
    lambda x: lax.scan(lambda c, y: (c * y, c), F32(0.1).astype(float), x)[0],
    lambda x: lax.scan(lambda c, _: (jnp.sin(c), None), x, None, length=3)[0],
    lambda x: lax.scan(lambda c, _: (c * F32(0.1), None), x, None, length=2, unroll=2)[0],
    lambda x: lax.scan(lambda c, k: (c, x * c), jnp.float32(1), jnp.arange(2))[1].sum(axis=0),
    lambda x: lax.scan(
        lambda c, k: ((c[0] * F32(1.1), c[1] * c[0]), None), (F32(0.1), x), None, length=4
    )[0][1],
    lambda x: lax.map(lambda y: y * 2, x),
    lambda x: lax.map(jnp.exp, x),
    lambda x: lax.map(lambda w: w @ x, W)[:, 0],
    lambda x: lax.map(lambda i: x[i], jnp.array([1, 0])),
    lambda x: lax.map(lambda y: y * jnp.sum(jnp.full(9, 0.1, F32)), x),
    lambda x: functools.reduce(lambda y, w: jnp.tanh(w @ y), W, x),
    lambda x: x * lax.scan(lambda c, k: (c * F32(1.1), None), F32(1), None, length=9)[0],
    lambda x: x * lax.fori_loop(0, 20, lambda k, c: jnp.cos(c), 1.0),
    lambda x: x * lax.while_loop(lambda c: c > 1e-3, lambda c: c / 3, F32(1)),
]

OVER_MASKS = [
    lambda x: lax.scan(lambda c, m: (jnp.where(m, 2 * c, c), None), x, MASKS)[0],
    lambda x: lax.scan(lambda c, m: (c * m, c), x, MASKS)[1][0],
    lambda x: lax.scan(lambda c, m: (c + m * F32(0.1), None), x, MASKS)[0],
    lambda x: lax.map(lambda m: jnp.where(m, x[0], x[1]), MASKS),
    lambda x: lax.map(lambda m: m * x[0], MASKS),
    lambda x: lax.fori_loop(0, 2, lambda k, y: jnp.where(MASKS[k], 2 * y, y), x),
    lambda x: lax.fori_loop(0, 3, lambda k, y: jnp.where(k > 0, 2 * y, y), x),
    lambda x: lax.scan(lambda m, y: (~m, jnp.where(m, y, 2 * y)), True, x)[1],
    lambda x: jax.vmap(lambda m, y: jnp.where(m, y, 0.0))(MASKS[:2], x),
    lambda x: jnp.sum(x[:, None] * MASKS, axis=1),
    lambda x: jnp.where(MASKS[:2] & jnp.array([True, True]), x, 0.5),
    lambda x: x * jnp.sum(MASKS),
    lambda x: x * jnp.mean(MASKS),
    lambda x: jnp.where(jnp.cumsum(MASKS)[:2] > 1, x, -x),
    lambda x: lax.map(lambda p: jnp.where(p[0], p[1], 0.1 * p[1]), (x > 0, x)),
    lambda x: lax.scan(lambda c, p: (c + jnp.where(p[0], p[1], -p[1]), p[0]), 0.0, (x > 0, x))[0],
]

CHOICES = [
    lambda x: jnp.where(x > 0, x, 0.1 * x),
    lambda x: jnp.where(x > 0.1, x - 0.1, 0.0),
    lambda x: jnp.where(x >= 0, x, -x),
    lambda x: jnp.where(x < 0, jnp.expm1(x), x),
    lambda x: jnp.where(jnp.array([1, 0]), x, 2 * x),
    lambda x: jnp.where(jnp.isnan(x), 0.0, x),
    lambda x: jnp.where(x == x, x, 0.0),
    lambda x: jnp.select([jnp.array([True, False])], [x], 2 * x),
    lambda x: lax.select(jnp.array([True, False]), x, 2 * x),
    lambda x: lax.select_n(jnp.array([2, 0]), x, 2 * x, 3 * x),
    lambda x: jnp.clip(x, 0.0, 0.5),
    lambda x: jnp.clip(x, F32(-0.1), F32(0.1)),
    lambda x: lax.clamp(0.1, x, 0.2),
    lambda x: jnp.clip(x, max=0.3),
    lambda x: jnp.maximum(x, 0.1),
    lambda x: jnp.maximum(x, x[::-1]),
    lambda x: jnp.minimum(x, jnp.asarray(0.1, jnp.float16)),
    lambda x: jnp.minimum(x**2, x),
    jnp.nan_to_num,
    lambda x: lax.cond(True, lambda y: y, lambda y: 2 * y, x),
    lambda x: lax.cond(jnp.sum(jnp.full(10, 0.1, F32)) > 1, lambda y: y, lambda y: 2 * y, x),
    lambda x: lax.switch(1, [lambda y: y, lambda y: 3 * y], x),
    lambda x: lax.switch(jnp.argmax(jnp.array([1.0, 3.0])), [jnp.sin, jnp.cos], x),
    lambda x: lax.platform_dependent(x, cpu=lambda y: 2 * y, default=lambda y: 2 * y),
    lambda x: jnp.select([x > 0.3, x > 0], [x, x], 0.0),
    lambda x: jnp.piecewise(x, [x < 0, x >= 0], [lambda y: -y, lambda y: y]),
    lambda x: lax.cond(x[0] > 0, lambda y: y[0], lambda y: -y[0], x),
    lambda x: jnp.piecewise(x[0], [x[0] < 0, x[0] >= 0.5], [jnp.negative, jnp.positive, jnp.abs]),
    lambda x: lax.map(lambda m: leaky(*m), ((2 * x).reshape(1, 2) > 0, (2 * x).reshape(1, 2)))[0],
    lambda x: first_of([0, x[0] > 0, 1], x),
]

ACTIVATIONS = [
    jax.nn.relu, jax.nn.relu6, jax.nn.elu, jax.nn.selu, jax.nn.celu, jax.nn.silu, jax.nn.swish,
    jax.nn.softplus, jax.nn.soft_sign, jax.nn.hard_tanh, jax.nn.hard_sigmoid, jax.nn.hard_swish,
    jax.nn.leaky_relu, jax.nn.log_sigmoid, jax.nn.mish, jax.nn.sigmoid, jax.nn.squareplus,
    jax.nn.sparse_plus, jax.nn.sparse_sigmoid, jax.nn.tanh, jax.nn.gelu, jax.nn.glu,
    lambda x: jax.nn.gelu(x, approximate=False),
    jax.nn.softmax, jax.nn.log_softmax, jax.nn.logsumexp, jax.nn.standardize,
    lambda x: jax.nn.softmax(jnp.outer(x, x), axis=0)[0],
    lambda x: jax.nn.softmax(x / F32(0.3)),
    lambda x: (x - jnp.mean(x)) / jnp.sqrt(jnp.var(x) + 1e-2),
    lambda x: x / jnp.sqrt(jnp.mean(x**2) + 1e-2),
    lambda x: x / (jnp.linalg.norm(x) + 1e-2),
    lambda x: x / jnp.linalg.norm(x),
]  # fmt: skip


@jax.custom_jvp
def own_slope(x):
    """A function with a derivative of its own."""
    return x * jnp.asarray(0.1, F32)


own_slope.defjvp(lambda primals, tangents: (own_slope(*primals), 0.3 * tangents[0]))


@jax.custom_vjp
def pulled_back(x):
    """A function whose derivative is pulled back."""
    return jnp.sin(x)


pulled_back.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (g * jnp.cos(x),))


@jax.custom_jvp
def summed(x):
    """A function with a derivative of its own, and a constant that is rounded."""
    return x * jnp.sum(jnp.full(100, 0.1, F32))


summed.defjvp(lambda primals, tangents: (summed(*primals), 10 * tangents[0]))

CALLS = [
    jax.jit(lambda x: 2 * x),
    jax.jit(lambda x: x * jnp.sum(jnp.full(100, 0.1, F32))),
    jax.jit(jax.jit(jnp.sin)),
    lambda x: jax.jit(lambda y, k: y * k, static_argnums=1)(x, 3),
    jax.checkpoint(lambda x: jnp.sin(x) * 2),
    jax.checkpoint(lambda x: x * jnp.mean(jnp.arange(7, dtype=F32) / 7)),
    jax.vmap(lambda y: y * y),
    lambda x: jax.vmap(jnp.dot, (0, None))(W[0], x),
    lambda x: jax.vmap(lambda w: jnp.tanh(w @ x))(W)[:, 0],
    lambda x: jax.vmap(lambda w: x * jnp.sum(w.astype(F32)), out_axes=1)(W)[0],
    own_slope,
    pulled_back,
    jax.vmap(own_slope),
    jax.grad(lambda x: jnp.sum(x**3)),
    jax.grad(lambda x: jnp.sum(jnp.sin(x))),
    lambda x: jax.jvp(jnp.sin, (x,), (jnp.ones(2),))[1],
    lambda x: jax.jacfwd(lambda y: y * y[::-1])(x)[0],
    lambda x: jax.hessian(lambda y: jnp.sum(y**3))(x)[0],
    jax.linearize(jnp.sin, jnp.full(2, 0.3))[1],
    lambda x: lax.stop_gradient(x) * 2,
    lambda x: lax.optimization_barrier(x) * 2,
    lambda x: jnp.vectorize(lambda a, b: a * b)(x, x[::-1]),
    lambda x: jnp.apply_along_axis(jnp.sum, 0, jnp.outer(x, x)),
    jax.named_call(jnp.sin, name="sine"),
    lambda x: lax.custom_root(
        lambda y: y - 2 * x, x, lambda f, y: y - f(y), lambda g, y: y / g(jnp.ones(2))
    ),
    Partial(jax.jit(lambda p, x: x * jnp.sum(p)), jnp.full(100, 0.1, F32)),
    Partial(jax.checkpoint(lambda p, x: x * jnp.sum(p)), jnp.full(100, 0.1)),
]

RNGS = nnx.Rngs(0)
CONV = nnx.Conv(1, 2, (2,), padding="VALID", rngs=RNGS)
EVALUATED = nnx.BatchNorm(2, use_running_average=True, rngs=RNGS)


class Gated(nn.Module):
    """A small network of flax linen."""

    @nn.compact
    def __call__(self, x):
        return nn.Dense(2)(nn.swish(nn.Dense(3)(x)) * nn.sigmoid(nn.Dense(3)(x)))


class Normalised(nn.Module):
    """A layer norm of flax linen."""

    @nn.compact
    def __call__(self, x):
        return nn.LayerNorm(epsilon=1e-2)(nn.Dense(3)(x))


def bound(module):
    """A module of flax linen with its parameters."""
    return Partial(module.apply, module.init(jax.random.key(0), jnp.ones(2)))


LAYERS = [
    nnx.Linear(2, 3, rngs=RNGS),
    nnx.Linear(2, 2, use_bias=False, rngs=RNGS),
    nnx.Linear(2, 2, param_dtype=jnp.bfloat16, rngs=RNGS),
    nnx.LinearGeneral(2, (2, 2), rngs=RNGS),
    nnx.Einsum("i,ij->j", (2, 2), rngs=RNGS),
    nnx.LayerNorm(2, epsilon=1e-2, rngs=RNGS),
    nnx.RMSNorm(2, epsilon=1e-2, rngs=RNGS),
    EVALUATED,
    nnx.Dropout(0.5, deterministic=True),
    nnx.Sequential(nnx.Linear(2, 3, rngs=RNGS), nnx.relu, nnx.Linear(3, 2, rngs=RNGS)),
    nnx.Sequential(nnx.Linear(2, 3, rngs=RNGS), jnp.tanh, nnx.Linear(3, 1, rngs=RNGS)),
    lambda x: CONV(x[:, None]).ravel(),
    bound(Gated()),
    bound(Normalised()),
    Partial(lambda cell, x: cell(jnp.zeros(2), x)[1], nnx.GRUCell(2, 2, rngs=RNGS)),
    lambda x: nnx.avg_pool(x[:, None], (2,)).ravel(),
    lambda x: nnx.max_pool(x[:, None], (2,)).ravel(),
    lambda x: jax.nn.one_hot(jnp.array([1]), 2)[0] * x,
]

REFUSED = [
    lambda x: first_of([x[0] > 0, 2], x),
    lambda x: first_of([-1, x[0] > 0], x),
    lambda x: jnp.interp(x, jnp.array([0.0, 0.3]), jnp.array([1.0, 2.0]), left=0.0, right=2.0),
    lambda x: lax.while_loop(lambda y: y[0] > 0.3, lambda y: y / 2, x),
    lambda x: lax.map(lambda m: m.astype(float), x > 0.1),
    lambda x: lax.scan(lambda m, y: (m & (y > 0), jnp.where(m, y, 2 * y)), True, x)[1],
    lambda x: jnp.where(x > 0, 1.0, -1.0),
    lambda x: jnp.where(x[0] > 0, x, 2 * x),
    lambda x: jnp.fmax(x, 0.2),
    lambda x: lax.cond(x[0] > 0, lambda y: y, lambda y: 2 * y, x),
    lambda x: jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0),
    lambda x: jnp.sign(x) * x,
    lambda x: (x > 0) | (x < 1),
    lambda x: jnp.logical_and(x > 0, x < 1) * x,
    lambda x: jax.nn.logsumexp(x, b=jnp.array([0.5, 2.0])),
    lambda x: jax.nn.dot_product_attention(
        jnp.outer(x, x)[None, :, None], W[:1, :, None], W[1:2, :, None]
    )[0, :, 0, 0],
    summed,
    lambda x: jax.grad(own_slope)(0.3) * x,
    lambda x: lax.custom_linear_solve(lambda y: 2 * y, x, lambda f, b: b / 2, symmetric=True),
    lambda x: x + jax.random.normal(jax.random.key(0), (2,)),
    lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((2,), float), x),
    nnx.Linear(2, 2, dtype=F32, rngs=RNGS),
    nnx.BatchNorm(2, rngs=RNGS),
    nnx.Dropout(0.5, rngs=RNGS),
    bound(nn.Dense(2, dtype=F32)),
]
"""What has no bounds, or not yet."""

FAMILIES = {
    "loops": LOOPS,
    "loops over masks": OVER_MASKS,
    "choices": CHOICES,
    "activations": ACTIVATIONS,
    "calls": CALLS,
    "layers": LAYERS,
}
