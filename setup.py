"""The two folders of data beside the package are put inside of it when it is built.

Everything else is in pyproject.toml, which cannot say this beside finding the packages.
"""

from pathlib import Path

from setuptools import find_packages, setup

SOURCES = sorted(path.parent.as_posix() for path in Path().glob("urdf_sources/*/source.yaml"))
FOLDERS = ["recipes", "recipes/lists", "urdf_sources", *SOURCES]
BUNDLED = {f"articugen._bundled.{folder.replace('/', '.')}": folder for folder in FOLDERS}

setup(
    packages=[*find_packages(include=["articugen*"]), *BUNDLED],
    package_dir=BUNDLED,
    package_data={"": ["*.yaml", "*.css", "*.js", "README.md", "py.typed", "*.pyi"]},
)
