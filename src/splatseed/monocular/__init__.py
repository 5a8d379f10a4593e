"""Depth from single photographs, by pretrained networks.

``load_network`` takes a network that is on this machine, in transformers' format or in ONNX, and
``estimate_depths`` runs it on a scene's photographs. Promise: nothing is downloaded; PyTorch and
transformers are imported only for networks that need them.
"""

from __future__ import annotations

from pathlib import Path

from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError
from splatseed.monocular.estimate import DepthReport, estimate_depths
from splatseed.monocular.network import DepthNetwork, DeviceName, Meaning
from splatseed.monocular.preparation import Preparation
from splatseed.requirements import require

__all__ = [
    "DepthNetwork",
    "DepthReport",
    "DeviceName",
    "Meaning",
    "Preparation",
    "estimate_depths",
    "load_network",
]


def load_network(
    model: str,
    *,
    kind: DepthKind | None = None,
    device: DeviceName = "auto",
    preparation: Preparation | None = None,
) -> DepthNetwork:
    """Load a depth network that is on this machine.

    Args:
        model: An ``.onnx`` file; a folder in transformers' format; or the id of a model that
            Hugging Face's cache holds.
        kind: What it predicts; None: what its configuration says.
        device: Where to run it; auto takes a usable GPU if there is one.
        preparation: How the input of an ONNX network is made, where its file does not say.

    Raises:
        MissingDependencyError: A package that runs it is not installed.
        SceneNotFoundError: It is not on this machine; says which command fetches it.
        SceneFormatError: It is not a depth network, or is damaged.
        ParameterError: There is no such device, nothing says what it predicts, or a preparation is
            given for a network that brings its own.
    """
    said = preparation or Preparation()
    if Path(model).suffix.lower() == ".onnx":
        require("onnxruntime")
        from splatseed.monocular.onnx_file import load_onnx  # noqa: PLC0415  (an extra)

        return load_onnx(Path(model), kind=kind, device=device, preparation=said)
    if said != Preparation():
        raise ParameterError(
            "--input-size, --input-multiple, --mean and --std for .onnx files only",
            found=f"{model}, whose image processor has its own",
            fix="Leave them out, or change its preprocessor_config.json.",
        )
    require("torch", "transformers")
    from splatseed.monocular.hugging_face import load_hugging_face  # noqa: PLC0415  (an extra)

    return load_hugging_face(model, kind=kind, device=device)
