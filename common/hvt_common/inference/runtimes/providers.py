"""Chooses the execution provider of the networks, and says why.

=========  =====================================  ============================================================
provider   package                                what it is
=========  =====================================  ============================================================
cpu        onnxruntime                            float32, the reference that every other provider is held to
openvino   openvino (``hvt[openvino]``)           bf16 where the processor has it, else float32
cuda       onnxruntime-gpu instead of onnxruntime  NVIDIA
tensorrt   the same, and TensorRT                 NVIDIA; builds its engine at the first start of a model
coreml     onnxruntime for macOS                  Apple
=========  =====================================  ============================================================

``auto`` takes cuda where it is installed, then openvino where three things hold: the network is not light, for
OpenVINO takes 150 MB itself; the processor computes in bf16, without which it is no faster than onnxruntime
(measured); and this network is measured to be quicker with it. Else cpu.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from hvt_common.errors import UserError

PROVIDERS = ("auto", "cpu", "cuda", "tensorrt", "openvino", "coreml")

ONNXRUNTIME_PROVIDERS: Mapping[str, tuple[str, ...]] = {
    "cpu": ("CPUExecutionProvider",),
    "cuda": ("CUDAExecutionProvider", "CPUExecutionProvider"),
    "tensorrt": ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"),
    "coreml": ("CoreMLExecutionProvider", "CPUExecutionProvider"),
}
"""onnxruntime's own names; the first that is able takes each operator, so the CPU stands last."""

_HOW_TO_GET: Mapping[str, str] = {
    "openvino": "pip install 'hvt[openvino]'",
    "cuda": "pip uninstall -y onnxruntime && pip install onnxruntime-gpu",
    "tensorrt": "pip uninstall -y onnxruntime && pip install onnxruntime-gpu tensorrt",
    "coreml": "it comes with onnxruntime on macOS only",
}


@dataclass(frozen=True, slots=True)
class OpenVinoCpu:
    """The installed OpenVINO and its abilities on this processor."""

    version: str
    bf16: bool


@dataclass(frozen=True, slots=True)
class ProviderChoice:
    """The provider that is taken."""

    provider: str
    """One of `PROVIDERS`, never ``auto``."""
    why: str
    """Half a sentence."""
    explicit: bool
    """The user named it; else ``auto`` chose it, and may fall back to cpu."""


def choose_provider(
    wanted: str,
    *,
    onnxruntime: Collection[str],
    openvino: Callable[[], OpenVinoCpu | None],
    light: bool = False,
) -> ProviderChoice:
    """Resolve ``wanted``, one of `PROVIDERS`, to a provider that is installed here.

    ``onnxruntime`` has the providers of the installed onnxruntime; ``openvino()`` looks for OpenVINO, where the
    answer matters, which for ``auto`` it does not where the network is ``light``. Raises `UserError` for an unknown
    word, or a provider that is not installed, with the command that installs it.
    """
    if wanted not in PROVIDERS:
        raise UserError(f"--provider '{wanted}' is not known: choose one of {', '.join(PROVIDERS)}")
    if wanted == "auto":
        return _best(onnxruntime, openvino, light=light)
    if wanted == "openvino":
        found = openvino()
        if found is not None:
            return ProviderChoice(wanted, _openvino_text(found), explicit=True)
    elif ONNXRUNTIME_PROVIDERS[wanted][0] in onnxruntime:
        return ProviderChoice(wanted, "as requested", explicit=True)
    raise UserError(
        f"--provider {wanted} is not installed here ({_HOW_TO_GET[wanted]}): choose auto or cpu, or install it"
    )


def _best(
    onnxruntime: Collection[str], openvino: Callable[[], OpenVinoCpu | None], *, light: bool
) -> ProviderChoice:
    if ONNXRUNTIME_PROVIDERS["cuda"][0] in onnxruntime:
        return ProviderChoice("cuda", "onnxruntime-gpu is installed", explicit=False)
    if light:
        return ProviderChoice("cpu", "so light a network is not worth OpenVINO's memory", explicit=False)
    found = openvino()
    if found is None:
        return ProviderChoice("cpu", f"OpenVINO is not installed ({_HOW_TO_GET['openvino']})", explicit=False)
    if not found.bf16:
        why = f"this processor has no bf16, without which OpenVINO {found.version} is no faster"
        return ProviderChoice("cpu", why, explicit=False)
    return ProviderChoice("openvino", _openvino_text(found), explicit=False)


def _openvino_text(found: OpenVinoCpu) -> str:
    if found.bf16:
        return f"OpenVINO {found.version} is installed and this processor computes in bf16"
    return f"OpenVINO {found.version} in float32, for this processor has no bf16"
