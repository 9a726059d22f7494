"""Export of a trained policy as a PyTorch program, an ONNX model or a C99 file.

Before a file is written, the export is compared with the policy on random observations, see :mod:`.agreement`.
"""

from rt_torchrl.export.c_file import export_c
from rt_torchrl.export.onnx_model import export_onnx
from rt_torchrl.export.program import export_program

__all__ = ["export_c", "export_onnx", "export_program"]
