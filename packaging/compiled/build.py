"""Build a wheel of ccatp whose frame path is machine code: `python build.py SOURCE WHEELS`, see docs/speed.md.

The source is copied beside the wheels first, so that nothing compiled ever lies in it. `modules.txt` names what mypyc
compiles.
"""

import os
import re
import shutil
import sys
import sysconfig
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
MESSAGES = re.compile(r"^class [^:]*(?:Struct|BaseModel|=)", re.MULTILINE)  # a class with a keyword is one of theirs
IGNORED = shutil.ignore_patterns("__pycache__", "*.so", "*.pyc")
# Types are checked by `make lint`, with everything installed that they need; here they only say what to compile to.
MYPY = "[mypy]\nplugins = pydantic.mypy\nignore_missing_imports = True\n"


def missing_tool() -> str | None:
    """What the machine lacks, or None."""
    compiler = str(sysconfig.get_config_var("CC") or "cc").split()[0]
    if shutil.which(os.environ.get("CC", compiler).split()[0]) is None:
        return f"no C compiler ({compiler}); on Debian: apt install gcc"
    if not Path(sysconfig.get_path("include"), "Python.h").is_file():
        return f"no C headers of Python {sysconfig.get_python_version()}; on Debian: apt install python3-dev"
    return None


def module_paths(tree: Path) -> Iterator[str]:
    """The files to compile, relative to the tree.

    Not those that define messages: compiled, a class loses the keywords and the annotations by which msgspec and
    pydantic know it, and a frame would leave the robot under another name.
    """
    for line in (HERE / "modules.txt").read_text(encoding="utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        found = sorted((tree / line).glob("*.py")) if (tree / line).is_dir() else [tree / line]
        if not found or not found[0].is_file():
            raise SystemExit(f"ccatp: modules.txt names {line}, which is not there")
        for path in found:
            if path.name != "__init__.py" and not MESSAGES.search(path.read_text(encoding="utf-8")):
                yield str(path.relative_to(tree))


def copy_of(source: Path, tree: Path) -> dict[str, Any]:
    """Copy what belongs into the wheel; returns what the project says of itself."""
    shutil.rmtree(tree, ignore_errors=True)
    shutil.copytree(source / "ccatp", tree / "ccatp", ignore=IGNORED)
    shutil.copytree(source / "configs", tree / "ccatp" / "configs", ignore=IGNORED)
    (tree / "mypy.ini").write_text(MYPY, encoding="utf-8")
    project: dict[str, Any] = tomllib.loads((source / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return project


def build(source: Path, wheels: Path) -> None:
    """Compile a copy of the source and put the wheel into a folder."""
    tree = wheels / "tree"
    project = copy_of(source, tree)
    version = re.search(r'__version__ = "(.+)"', (tree / "ccatp" / "__init__.py").read_text(encoding="utf-8"))
    os.chdir(tree)
    sys.path.insert(0, str(tree))  # the plugin of the models, and nothing installed elsewhere

    from mypyc.build import mypycify  # noqa: PLC0415 - the tools are looked for after what they need
    from setuptools import find_packages, setup  # noqa: PLC0415
    from setuptools.command.build_ext import build_ext  # noqa: PLC0415

    class BuildOnAllCores(build_ext):
        """Compiles the files of an extension side by side."""

        def build_extensions(self) -> None:
            one = self.compiler.compile

            def compile_all(sources: list[str], **options: Any) -> list[str]:
                with ThreadPoolExecutor(os.cpu_count()) as pool:
                    done = pool.map(lambda source: one([source], **options), sources)
                    return [found for objects in done for found in objects]

            self.compiler.compile = compile_all
            super().build_extensions()

    modules = mypycify(
        ["--config-file", "mypy.ini", *module_paths(tree)], opt_level="2", debug_level="0", multi_file=True
    )
    setup(
        name=project["name"],
        version=version.group(1) if version else "0",
        python_requires=project["requires-python"],
        install_requires=project["dependencies"],
        packages=find_packages(include=["ccatp", "ccatp.*"]),
        package_data={"": ["py.typed", "*.pyi", "configs/**/*", "static/*"]},
        entry_points={"console_scripts": [f"{name} = {at}" for name, at in project["scripts"].items()]},
        ext_modules=modules,
        cmdclass={"build_ext": BuildOnAllCores},
        script_args=["--quiet", "bdist_wheel", "--dist-dir", str(wheels)],
    )


if __name__ == "__main__":
    lacking = missing_tool()
    if lacking is not None:
        raise SystemExit(f"ccatp: the compiled build cannot be made: {lacking}. `make run` needs none of it.")
    build(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
