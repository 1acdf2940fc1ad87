"""Reading URDF: XML to frozen data, checked link by link and joint by joint."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

from torchcal.errors import JobError, choices
from torchcal.model.meshes import FARTHEST
from torchcal.model.regular_file import irregular
from torchcal.model.urdf_tree import (
    GEOMETRIES,
    JOINT_KINDS,
    Joint,
    Link,
    Mimic,
    Origin,
    Shape,
    Urdf,
)

DEEPEST = 200
"""Most joints one after another: forward kinematics climbs the tree by recursion."""
_EXPECTED = "a URDF: XML whose root element is <robot>"


class _WithoutDoctype(ET.TreeBuilder):
    """Refuses a DOCTYPE: entities could grow without bounds or read other files."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError(f"a DOCTYPE ({name})")


def read_xml(file: Path) -> ET.Element:
    """The ``<robot>`` element of a URDF, comments included.

    Raises:
        JobError: If the file is missing, is not XML, has a DOCTYPE or is no URDF.
    """
    if not file.is_file():
        raise JobError(file, "", irregular(file) or "no such file", _EXPECTED)
    return parse_xml(file, file.read_bytes())


def parse_xml(file: Path, content: bytes) -> ET.Element:
    """The ``<robot>`` element of a URDF, comments included.

    Args:
        file: Where it comes from, for the message of an error.
        content: The URDF.

    Raises:
        JobError: If it is not XML, has a DOCTYPE or is no URDF.
    """
    parser = ET.XMLParser(target=_WithoutDoctype(insert_comments=True))
    try:
        root = ET.fromstring(content, parser)
    except (ET.ParseError, ValueError, LookupError) as error:
        raise JobError(file, "", f"{error}", _EXPECTED) from error
    if root.tag != "robot":
        raise JobError(file, "", f"the root element <{root.tag}>", _EXPECTED)
    if any(isinstance(element.tag, str) and "xacro}" in element.tag for element in root.iter()):
        raise JobError(file, "", "unexpanded xacro", "a plain URDF: run xacro on the file first")
    return root


def read_urdf(file: Path) -> Urdf:
    """Reads and checks a URDF; meshes are not opened.

    Raises:
        JobError: For the first mistake, with its key, such as ``joint.elbow.type``.
    """
    return urdf_of(file, read_xml(file))


def urdf_of(file: Path, root: ET.Element) -> Urdf:
    """Checks a URDF whose XML was read.

    Args:
        file: Where it comes from, for the message of an error.
        root: Its ``<robot>`` element.

    Raises:
        JobError: For the first mistake, with its key, such as ``joint.elbow.type``.
    """
    materials = _materials(file, root)
    links = tuple(_link(file, element, materials) for element in root.findall("link"))
    joints = tuple(_joint(file, element) for element in root.findall("joint"))
    _check_names(file, "link", [link.name for link in links])
    _check_names(file, "joint", [joint.name for joint in joints])
    _check_tree(file, [link.name for link in links], joints)
    return Urdf(file=file, name=root.get("name", file.stem), links=links, joints=joints)


def _numbers(
    file: Path, key: str, text: str, count: int, most: float = math.inf
) -> tuple[float, ...]:
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(v) and abs(v) <= most for v in values):
        limit = f" of at most {most:g}" if math.isfinite(most) else ""
        expected = f"{count} finite number{'s' if count > 1 else ''}{limit}"
        raise JobError(file, key, repr(text), expected)
    return values


def _attribute(file: Path, key: str, element: ET.Element | None, name: str) -> str:
    value = None if element is None else element.get(name)
    if not value:
        raise JobError(file, key, f"no {name}", f"the attribute {name}")
    return value


def _origin(file: Path, key: str, element: ET.Element) -> Origin:
    origin = element.find("origin")
    if origin is None:
        return Origin()
    return Origin(
        xyz=_numbers(file, f"{key}.origin.xyz", origin.get("xyz", "0 0 0"), 3, FARTHEST),
        rpy=_numbers(file, f"{key}.origin.rpy", origin.get("rpy", "0 0 0"), 3),
    )


def _materials(file: Path, root: ET.Element) -> dict[str, tuple[float, ...]]:
    """The colours of all named materials: a link may use one that another link defines."""
    found = {}
    for material in root.iter("material"):
        colour = _colour(file, material, {})
        if colour is not None:
            found[material.get("name", "")] = colour
    return found


def _colour(
    file: Path, material: ET.Element | None, named: dict[str, tuple[float, ...]]
) -> tuple[float, ...] | None:
    if material is None:
        return None
    colour, name = material.find("color"), material.get("name", "")
    if colour is None:
        return named.get(name)
    return _numbers(file, f"material.{name}.color", colour.get("rgba", ""), 4)


def _link(file: Path, element: ET.Element, materials: dict[str, tuple[float, ...]]) -> Link:
    name = _attribute(file, "link", element, "name")
    part = "visual" if element.find("visual") is not None else "collision"
    shapes = tuple(
        _shape(file, f"link.{name}.{part}[{index}]", shape, materials)
        for index, shape in enumerate(element.findall(part))
    )
    return Link(name=name, shapes=shapes)


def _shape(
    file: Path, key: str, element: ET.Element, materials: dict[str, tuple[float, ...]]
) -> Shape:
    geometry = element.find("geometry")
    kinds = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]
    if len(kinds) != 1 or kinds[0].tag not in GEOMETRIES:
        found = " and ".join(f"<{child.tag}>" for child in kinds) or "nothing"
        raise JobError(file, f"{key}.geometry", found, choices(GEOMETRIES))
    kind = kinds[0].tag
    key = f"{key}.geometry.{kind}"
    return Shape(
        key=key,
        kind=kind,
        size=_size(file, key, kinds[0]),
        filename=_attribute(file, key, kinds[0], "filename") if kind == "mesh" else "",
        origin=_origin(file, key, element),
        colour=_colour(file, element.find("material"), materials),
    )


def _size(file: Path, key: str, geometry: ET.Element) -> tuple[float, ...]:
    if geometry.tag == "mesh":
        size = _numbers(file, f"{key}.scale", geometry.get("scale", "1 1 1"), 3, FARTHEST)
        expected, right = "three numbers that are not 0", all(value != 0 for value in size)
    else:
        names = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
        texts = [_attribute(file, key, geometry, name) for name in names[geometry.tag]]
        count = {"box": 3, "cylinder": 2, "sphere": 1}[geometry.tag]
        size = _numbers(file, key, " ".join(texts), count, FARTHEST)
        expected, right = "lengths above 0", all(value > 0 for value in size)
    if not right:
        raise JobError(file, key, " ".join(f"{value:g}" for value in size), expected)
    return size


def _joint(file: Path, element: ET.Element) -> Joint:
    name = _attribute(file, "joint", element, "name")
    key = f"joint.{name}"
    kind = element.get("type", "")
    if kind not in JOINT_KINDS:
        raise JobError(file, f"{key}.type", repr(kind), choices(JOINT_KINDS))
    return Joint(
        name=name,
        kind=kind,
        parent=_attribute(file, f"{key}.parent", element.find("parent"), "link"),
        child=_attribute(file, f"{key}.child", element.find("child"), "link"),
        origin=_origin(file, key, element),
        axis=_axis(file, key, element),
        limits=_limits(file, key, kind, element.find("limit")),
        mimic=_mimic(file, key, element.find("mimic")) if kind != "fixed" else None,
    )


def _axis(file: Path, key: str, element: ET.Element) -> tuple[float, ...]:
    axis = element.find("axis")
    text = "1 0 0" if axis is None else axis.get("xyz", "1 0 0")
    values = _numbers(file, f"{key}.axis.xyz", text, 3)
    if element.get("type") != "fixed" and not any(values):
        raise JobError(file, f"{key}.axis.xyz", repr(text), "an axis that is not 0")
    return values


def _limits(file: Path, key: str, kind: str, limit: ET.Element | None) -> tuple[float, float]:
    if kind in ("fixed", "continuous"):
        return -math.inf, math.inf
    if limit is None:
        raise JobError(file, f"{key}.limit", "nothing", f"the limits of a {kind} joint")
    text = f"{limit.get('lower', '0')} {limit.get('upper', '0')}"
    lower, upper = _numbers(file, f"{key}.limit", text, 2)
    if lower > upper:
        raise JobError(file, f"{key}.limit", f"lower {lower:g}, upper {upper:g}", "lower <= upper")
    return lower, upper


def _mimic(file: Path, key: str, mimic: ET.Element | None) -> Mimic | None:
    if mimic is None:
        return None
    text = f"{mimic.get('multiplier', '1')} {mimic.get('offset', '0')}"
    multiplier, offset = _numbers(file, f"{key}.mimic", text, 2)
    joint = _attribute(file, f"{key}.mimic", mimic, "joint")
    return Mimic(joint=joint, multiplier=multiplier, offset=offset)


def _check_names(file: Path, what: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise JobError(file, f"{what}.{twice[0]}", "the name twice", f"one {what} of each name")


def _check_tree(file: Path, links: list[str], joints: tuple[Joint, ...]) -> None:
    """One root, and every other link reached from it by exactly one joint."""
    for joint in joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise JobError(file, f"joint.{joint.name}.{end}", repr(link), choices(links))
    children = [joint.child for joint in joints]
    for joint in joints:
        if children.count(joint.child) > 1:
            found = f"{joint.child!r}, which is the child of another joint too"
            raise JobError(file, f"joint.{joint.name}.child", found, "one parent for every link")
    roots = [link for link in links if link not in children]
    if len(roots) != 1:
        found = f"{len(roots)} root links" + (f" ({', '.join(roots)})" if roots else "")
        raise JobError(file, "", found if links else "no links", "one tree with one root link")
    _check_reached(file, links, roots[0], joints)


def _check_reached(file: Path, links: list[str], root: str, joints: tuple[Joint, ...]) -> None:
    reached, parents, depth = {root}, {root}, -1
    while parents:
        depth += 1
        parents = {joint.child for joint in joints if joint.parent in parents}
        reached |= parents
    lost = [link for link in links if link not in reached]
    if lost:
        raise JobError(
            file, "", f"a cycle through {', '.join(lost)}", "one tree with one root link"
        )
    if depth > DEEPEST:
        raise JobError(file, "", f"{depth} joints in a chain", f"at most {DEEPEST}")
