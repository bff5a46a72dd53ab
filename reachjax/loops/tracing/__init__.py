"""JAX functions as steps of affine maps, products and units, which any kind of number runs."""
