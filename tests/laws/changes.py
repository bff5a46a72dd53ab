"""Changes of sets and tubes: small ones, and those of somebody who wants to deceive."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import reachjax as rj
from reachjax.proofs.certificates import AbstractProof


def same(one, other):
    """Whether two trees are the same, bit for bit."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


def alike(one, other):
    """Whether two trees are the same, up to the rounding of a proof that is made again."""
    if jax.tree.structure(one) != jax.tree.structure(other):
        return False
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.allclose(*pair, rtol=1e-12, atol=1e-15, equal_nan=True) for pair in pairs)


def is_proof(node):
    return isinstance(node, AbstractProof)


def unclaimed(tree):
    """A tube, or several, without what a recheck does not say: how searches ended, and seconds."""

    def without(node):
        if not is_proof(node):
            return node
        parts = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
        nested = {
            name: jax.tree.map(without, part, is_leaf=is_proof)
            for name, part in parts.items()
            if is_proof(part) or type(part) is tuple
        }
        return node.replace(**nested, codes=0 * node.codes, seconds=0 * node.bounds)

    parts = tree.tubes if isinstance(tree, rj.PartitionedTube) else (tree,)
    return [
        (t.loop, t.template, t.sets, jax.tree.map(without, t.certificates, is_leaf=is_proof))
        if isinstance(t, rj.ReachTube)
        else t
        for t in parts
    ]


def smaller(X, by=0.01):
    """A set that is smaller by a part of its width at each side."""
    flat, ball = X.parts
    if isinstance(flat, rj.Box):
        flat = rj.Box(flat.lower + by * flat.widths, flat.upper - by * flat.widths)
    elif flat is not None:
        A, b = flat.facets
        flat = rj.Polytope(A, b - by * (b + flat.support(-A)))
    if ball is not None:
        ball = ball.replace(shape=(1 - by) * ball.shape)
    return rj.Intersection(flat, ball) if flat and ball else flat or ball


def with_less(tube, k, witnesses=None):
    """A smaller set, and a certificate that says the same, perhaps with other witnesses."""
    X, proof = smaller(tube.sets[k]), tube.proof(k)
    flat, ball = X.parts
    bounds = np.array(proof.bounds)
    if flat is not None:
        bounds[: len(flat.facets[1])] = flat.facets[1]
    if ball is not None:
        proof = proof.replace(level=proof.level * np.sqrt(0.99))
        around = rj.Ellipsoid.enclosing(proof.form, proof.level)
        X = rj.Intersection(flat, around) if flat else around
    proof = proof.replace(bounds=jnp.asarray(bounds))
    if witnesses is not None:
        proof = proof.replace(witnesses=jnp.full(len(bounds), witnesses))
    return at(tube, k, X, proof)


def at(tube, k, X=None, proof=None):
    """Sets and certificates with others at one time."""
    sets, proofs = list(tube.sets), list(tube.certificates)
    sets[k], proofs[k] = X or sets[k], proof or proofs[k]
    return {"sets": tuple(sets), "certificates": tuple(proofs)}


def closer(tube, k):
    """Witnesses that leave less open than there is."""
    proof = tube.proof(k)
    gaps = np.asarray(proof.gaps)
    nearer = proof.witnesses + np.where(gaps > 1e-6, gaps / 2, 1e-3)
    return at(tube, k, proof=proof.replace(witnesses=nearer))


def exchanged(these, i, j):
    """A tuple whose entries at two places are exchanged."""
    found = list(these)
    found[i], found[j] = found[j], found[i]
    return tuple(found)


def moved(X, by):
    """A set elsewhere."""
    return X.replace(lower=X.lower + by, upper=X.upper + by)


def wider(X):
    """A set that is larger by a quarter at each side."""
    return X.replace(lower=X.lower - X.widths / 4, upper=X.upper + X.widths / 4)


def another(loop):
    """The loop with other numbers of its plant and its controller."""
    plant, controller = jax.tree.map(lambda leaf: 1.7 * leaf, (loop.plant, loop.controller))
    return loop.replace(plant=plant, controller=controller)


CHANGES = {
    "a set made smaller": lambda tube: at(tube, 2, smaller(tube.sets[2])),
    "an initial set elsewhere": lambda tube: at(tube, 0, moved(tube.sets[0], 100.0)),
    "a larger initial set": lambda tube: at(tube, 0, wider(tube.sets[0])),
    "another loop": lambda tube: {"loop": another(tube.loop)},
    "certificates exchanged": lambda tube: {"certificates": exchanged(tube.certificates, 1, 2)},
    "steps exchanged": lambda tube: {
        "sets": exchanged(tube.sets, 1, 2),
        "certificates": exchanged(tube.certificates, 1, 2),
    },
    "a set left out": lambda tube: {"sets": tube.sets[:-1]},
    "another start": lambda tube: {"start": tube.start + 3},
    "lower bounds": lambda tube: with_less(tube, 3),
    "lower bounds and no witnesses": lambda tube: with_less(tube, 3, -1e300),
    "closer witnesses": lambda tube: closer(tube, 2),
}
"""What somebody may change in a tube before it is sealed again."""


def parts_of(tube):
    """What a seal is of."""
    names = "loop", "template", "sets", "certificates", "start"
    return {name: getattr(tube, name) for name in names}


def changed(tube, change):
    """A tube with one change, sealed again; of a partition, its first cell."""
    if isinstance(tube, rj.PartitionedTube):
        return rj.PartitionedTube.sealed(tube.X0, (changed(tube[0], change), *tube[1:]))
    return rj.ReachTube.sealed(**(parts_of(tube) | CHANGES[change](tube)))
