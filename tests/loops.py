"""The library's loops from the arrays of `tests.networks`."""

import reachjax as rj
from tests.networks import LoopData, he_network, input_box, plant


def closed_loop(data: LoopData) -> rj.ClosedLoop:
    """The loop that the arrays describe."""
    return rj.ClosedLoop(
        rj.AffinePlant(data.A, data.B, data.c),
        rj.MLP.from_layers(data.layers),
        input_box=None if data.u_lower is None else rj.Box(data.u_lower, data.u_upper),
    )


def random_loop(n_x, hidden=(6, 4), seed=0, boxed=True, steps=None, network=he_network):
    """Arrays of a loop with `n_x` states; with `steps` it is time-varying."""
    n_u = min(n_x, 2)
    box = input_box(n_u, seed, steps) if boxed else (None, None)
    layers = network((n_x, *hidden, n_u), seed)
    return LoopData(layers, *plant(n_x, n_u, seed, steps), *box)
