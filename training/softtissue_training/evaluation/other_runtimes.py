"""The estimators' networks in other inference runtimes, where they are installed, for comparison."""

from __future__ import annotations

import importlib
import tempfile
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

Runner = Callable[[Tensor], Tensor]


def missing_packages(runtime: str) -> list[str]:
    """Return which packages a runtime, 'ONNX Runtime' or 'OpenVINO', lacks here."""
    return [name for name in _PACKAGES[runtime] if find_spec(name) is None]


def onnx_runtime(network: nn.Module, example: Tensor, precision: str, threads: int) -> Runner:
    """Return a network (float32, on the CPU) as ONNX Runtime runs it; it has no reduced precision on a CPU."""
    if precision != "float32":
        raise ValueError(f"precision: expected float32, got {precision}")
    onnxruntime: Any = importlib.import_module("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Its threads would otherwise go on taking the cores for a while and slow down what is timed after it.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's, on checks of shapes and on its own retirement
        path = Path(folder) / "network.onnx"
        torch.onnx.export(network, (example,), path, dynamo=False, input_names=["inputs"])
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

    def run(inputs: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {"inputs": inputs.numpy()})[0])

    return run


def openvino(network: nn.Module, example: Tensor, precision: str, threads: int) -> Runner:
    """Return a network (float32, on the CPU) as OpenVINO runs it."""
    library: Any = importlib.import_module("openvino")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the tracer's, on checks of shapes
        shape = library.PartialShape(list(example.shape))
        model = library.convert_model(network, example_input=example, input=[shape])
    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16", "float16": "f16"}[precision],
        "INFERENCE_NUM_THREADS": threads,
    }
    compiled = library.Core().compile_model(model, "CPU", settings)
    request, output = compiled.create_infer_request(), compiled.output(0)

    def run(inputs: Tensor) -> Tensor:
        return torch.from_numpy(request.infer({0: inputs.numpy()}, share_inputs=True)[output])

    return run


_PACKAGES = {"ONNX Runtime": ("onnx", "onnxruntime"), "OpenVINO": ("openvino",)}
RUNTIMES: dict[str, Callable[[nn.Module, Tensor, str, int], Runner]] = {
    "ONNX Runtime": onnx_runtime,
    "OpenVINO": openvino,
}
