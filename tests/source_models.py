"""Small models on the disk, as sources hold them."""

from pathlib import Path

URDF = """<robot name="r"><link name="a"><visual><geometry>{}</geometry></visual></link>
<link name="b"/>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/></joint></robot>"""
BOX_URDF = URDF.format('<box size="1 2 3"/>')


def add(path: Path, text: str = BOX_URDF) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def add_partnet(folder: Path, category: str) -> None:
    add(folder / "mobility.urdf")
    add(folder / "meta.json", f'{{"model_cat": "{category}"}}')
