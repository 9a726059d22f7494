"""Object code: LLVM's text compiled for this processor, kept on disk, and loaded."""

import ctypes
import hashlib
from collections.abc import Callable
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
from platformdirs import user_cache_path

from rt_torchrl.atomic_file import write_atomically
from rt_torchrl.programs.vector_functions import publish_scalar_functions

OPTIMISATION = 2
DIGEST = hashlib.sha256().digest_size
_memory_of = (ctypes.c_char * 0).from_buffer  # four times faster than the array's own address


class ObjectCode:
    """A function of machine code, which stays loaded as long as this object lives.

    Args:
        text: LLVM's text of a module.
        name: name of the function.
        arguments: types of the arguments of the function.
    """

    def __init__(self, text: str, name: str, arguments: tuple[type, ...]):
        publish_scalar_functions()
        code = llvm.ObjectFileRef.from_data(_compiled(text))
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        self._engine.add_object_file(code)
        self._engine.finalize_object()
        self._function = ctypes.CFUNCTYPE(None, *arguments)(self._engine.get_function_address(name))

    def __call__(self, *arguments: np.ndarray | int) -> None:
        """Run the function; of an array, whose numbers lie side by side, it gets the address."""
        self._function(*(x if isinstance(x, int) else _memory_of(x.data) for x in arguments))

    def bound(self, *arguments: np.ndarray | int) -> Callable[[], None]:
        """The call with these arrays, whose numbers may change between calls; it keeps their memory alive."""
        return partial(self._function, *(x if isinstance(x, int) else _memory_of(x.data) for x in arguments))


def _compiled(text: str) -> bytes:
    """Object code of a text: from the disk, where its name is the digest of everything it depends on, or made anew.

    A file begins with the digest of its code; one that is damaged is made again.
    """
    identity = (text, llvm.llvm_version_info, version("llvmlite"), llvm.get_host_cpu_name(), _features(), OPTIMISATION)
    path = cache_folder() / f"{hashlib.sha256(repr(identity).encode()).hexdigest()}.o"
    try:
        held = path.read_bytes()
    except OSError:
        held = b""
    if held and hashlib.sha256(held[DIGEST:]).digest() == held[:DIGEST]:
        return held[DIGEST:]
    code = _compile(text)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, hashlib.sha256(code).digest() + code)
    except OSError:
        pass  # where nothing can be kept, the next process compiles again
    return code


def cache_folder() -> Path:
    """The folder of object code in the user's cache."""
    return user_cache_path("rt_torchrl") / "native"


def _compile(text: str) -> bytes:
    machine = _machine()
    module = llvm.parse_assembly(text)
    module.verify()
    options = llvm.create_pipeline_tuning_options(speed_level=OPTIMISATION)
    options.slp_vectorization = options.loop_vectorization = False  # the lanes are the vectors
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return bytes(machine.emit_object(module))


def _machine() -> llvm.TargetMachine:
    """A new description of this processor, because the code that is loaded with one frees it."""
    target = _target()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=_features(), opt=OPTIMISATION, jit=True)


@cache
def _target() -> llvm.Target:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple()


@cache
def _features() -> str:
    return str(llvm.get_host_cpu_features().flatten())
