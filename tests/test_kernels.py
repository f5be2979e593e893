"""Kernels are recompiled when what they read has changed."""

import ast
from pathlib import Path

import imudrv
from imudrv.kernels import CONSTANTS

PACKAGE = Path(imudrv.__file__).parent


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any(
        isinstance(d, ast.Name) and d.id == "kernel" for d in node.decorator_list
    )


def test_what_kernels_read_of_other_modules_is_hashed_too() -> None:
    sources = {p.relative_to(PACKAGE).as_posix(): p.read_text() for p in PACKAGE.rglob("*.py")}
    hashed = {name for name, text in sources.items() if "@kernel" in text} | set(CONSTANTS)
    read = set()
    for name in hashed:
        tree = ast.parse(sources[name])
        kernels = [node for node in tree.body if is_kernel(node)]
        # bodies alone: annotations compile to nothing
        bodies = [statement for kernel in kernels for statement in kernel.body]
        used = {n.id for statement in bodies for n in ast.walk(statement) if isinstance(n, ast.Name)}
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("imudrv."):
                home = node.module.removeprefix("imudrv.").replace(".", "/") + ".py"
                if used & {alias.asname or alias.name for alias in node.names}:
                    read.add(home)
    assert "units.py" in read
    assert read <= hashed, read - hashed
