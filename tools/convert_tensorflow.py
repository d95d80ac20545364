"""Convert a TensorFlow checkpoint or frozen graph to NumPy arrays by name (.npz), which facediff reads.

Needs TensorFlow (``pip install tensorflow``), once; facediff itself does not. For VOCA:

    python convert_tensorflow.py gstep_52280.model voca.npz
    python convert_tensorflow.py output_graph.pb deepspeech.npz
    facediff import-checkpoint voca.npz deepspeech.npz --templates templates.pkl -o voca.ckpt

A checkpoint is named by the common beginning of its files (``gstep_52280.model`` of ``gstep_52280.model.index``); a
frozen graph by its file (``.pb``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np


def read_checkpoint(prefix: Path) -> dict[str, np.ndarray]:
    """All variables of a checkpoint by name."""
    import tensorflow as tf

    reader = tf.train.load_checkpoint(str(prefix))
    return {name: np.asarray(reader.get_tensor(name)) for name in reader.get_variable_to_shape_map()}


def read_graph(path: Path) -> dict[str, np.ndarray]:
    """The weights of a frozen graph by name: its floating-point constants of one dimension or more."""
    import tensorflow as tf

    graph = tf.compat.v1.GraphDef()
    graph.ParseFromString(path.read_bytes())
    constants = {node.name: tf.make_ndarray(node.attr["value"].tensor) for node in graph.node if node.op == "Const"}
    return {name: value for name, value in constants.items() if value.dtype.kind == "f" and value.ndim}


def main() -> None:
    """Read the arguments and convert."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path, help="beginning of a checkpoint's file names, or a frozen graph (.pb)")
    parser.add_argument("output", type=Path, help="file to write (.npz)")
    options = parser.parse_args()
    prefix = options.source.with_suffix("") if options.source.suffix == ".index" else options.source
    arrays = read_graph(options.source) if options.source.suffix == ".pb" else read_checkpoint(prefix)
    with options.output.open("wb") as stream:
        np.savez(stream, **arrays)
    print(f"{options.output}: {len(arrays)} arrays")


if __name__ == "__main__":
    main()
