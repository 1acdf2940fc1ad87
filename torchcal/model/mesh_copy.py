"""Copying a mesh file together with the files that it names: an OBJ's materials, images."""

import re
import shutil
from pathlib import Path
from urllib.parse import unquote

_MATERIAL_LIBRARY = re.compile(r"(?m)^(\s*mtllib\s+)(.+?)(\s*)$")
_MATERIAL_IMAGE = re.compile(r"(?m)^(\s*(?:map_\w+|bump|disp|decal|norm)\s.*?)(\S+)([ \t]*)$")
_COLLADA_IMAGE = re.compile(r"(<init_from>\s*)([^<]+?)(\s*</init_from>)")
_GLTF_FILE = re.compile(r"(\"uri\"\s*:\s*\")([^\"]+)(\")")
_REFERENCES = {
    ".obj": _MATERIAL_LIBRARY,
    ".mtl": _MATERIAL_IMAGE,
    ".dae": _COLLADA_IMAGE,
    ".gltf": _GLTF_FILE,
}


class MeshFolder:
    """A folder that takes copies of files, each once and each under a name of its own.

    Args:
        folder: Where the copies go; made when the first one comes.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._copies: dict[Path, str] = {}

    def add(self, source: Path) -> str:
        """Copies a file and what it names, and returns the copy's name in the folder.

        A name in the file that leads to no file stays as it is.
        """
        source = source.resolve()
        if source not in self._copies:
            name = self._copies[source] = self._free_name(source)
            self.folder.mkdir(parents=True, exist_ok=True)
            self._write(source, self.folder / name)
        return self._copies[source]

    def _free_name(self, source: Path) -> str:
        taken, count, name = set(self._copies.values()), 1, source.name
        while name in taken:
            count += 1
            name = f"{source.stem}_{count}{source.suffix}"
        return name

    def _write(self, source: Path, copy: Path) -> None:
        pattern = _REFERENCES.get(source.suffix.lower())
        if pattern is None:
            if copy.resolve() != source:
                shutil.copyfile(source, copy)
            return
        text = source.read_text(encoding="utf-8", errors="surrogateescape")
        text = pattern.sub(lambda match: self._renamed(source, match), text)
        copy.write_text(text, encoding="utf-8", errors="surrogateescape")

    def _renamed(self, source: Path, match: re.Match[str]) -> str:
        before, name, after = match.groups()
        named = source.parent / unquote(name.removeprefix("file://"))
        if not named.is_file():
            return match.group(0)
        return f"{before}{self.add(named)}{after}"
