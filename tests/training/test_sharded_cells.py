"""Cells of a penalty are sharded over devices by JAX's own means, which changes no number."""

import os
import subprocess
import sys

import pytest

DEVICES = 4

SHARDED = """
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import reachjax as rj

jax.config.update("jax_enable_x64", True)
rng = np.random.default_rng(0)
layers = [(rng.normal(size=(4, 2)), rng.normal(size=4)), (rng.normal(size=(1, 4)), np.zeros(1))]
net = rj.MLP.from_layers(layers)
plant = rj.AffinePlant([[1.0, 0.2], [0.0, 1.0]], [[0.02], [0.2]])
template, safe = rj.Template.box(2), rj.Box([-0.2, -0.2], [0.2, 0.2])


def penalty(net, lower, upper):
    def of_cell(lower, upper):
        loop, cell = rj.ClosedLoop(plant, net), rj.Box(lower, upper)
        return rj.specification_penalty(loop, cell, 3, template, safe=safe)

    return jnp.mean(jax.vmap(of_cell)(lower, upper))


lower = rng.uniform(-0.5, 0.3, (8, 2))
cells = lower, lower + 0.1
both = jax.jit(jax.value_and_grad(penalty))
value, gradient = both(net, *cells)

mesh = Mesh(np.array(jax.devices()), ("cells",))
everywhere = NamedSharding(mesh, PartitionSpec())
split = NamedSharding(mesh, PartitionSpec("cells"))
placed = jax.device_put(net, everywhere), *jax.device_put(cells, split)
sharded, slopes = both(*placed)
code = both.lower(*placed).compile()

print(len(placed[1].sharding.device_set), len(sharded.sharding.device_set))
print("all-reduce" in code.as_text())
print(float(value) > 0, np.isclose(sharded, value, rtol=1e-12, atol=0))
pairs = zip(jax.tree.leaves(slopes), jax.tree.leaves(gradient), strict=True)
print(all(np.allclose(one, other, rtol=1e-9, atol=1e-12) for one, other in pairs))
print(any(np.any(np.asarray(leaf) != 0) for leaf in jax.tree.leaves(gradient)))
"""


@pytest.mark.costly
def test_a_penalty_over_sharded_cells_is_that_of_one_device():
    flags = f"--xla_force_host_platform_device_count={DEVICES}"
    given = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", SHARDED]
    done = subprocess.run(command, env=given, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(DEVICES), str(DEVICES), *["True"] * 5], done.stdout
