"""Export: policies as C99 or ONNX models; controllers and twins as C99.

Before a file is written, it is compared with what it was made of, see :mod:`.agreement`.
"""

from rt_torchrl.export.c_controller import export_controller
from rt_torchrl.export.c_file import export_c, export_twin
from rt_torchrl.export.program import export_onnx

__all__ = ["export_c", "export_controller", "export_onnx", "export_twin"]
