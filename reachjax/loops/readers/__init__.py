"""Networks that other tools wrote: flax's layers, ONNX graphs, files of the field's benchmarks."""
