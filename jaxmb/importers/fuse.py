"""Links that are fixed to each other as one body, and joints in succession between links without mass."""

import dataclasses

import numpy as np

from ..parts.base import GROUND
from .chains import PlacedLink
from .description import WORLD, Joint, Link, LinkKey, Machine
from .light import bodies_of
from .notes import Notes


@dataclasses.dataclass
class Chain:
    """Joints in succession from one body to the next."""

    joints: list[Joint]
    parent: LinkKey
    child: LinkKey


@dataclasses.dataclass
class Fused:
    """The links as bodies and chains of joints.

    **Fields:** `carriers`: the bodies, with their names in the scene, by the name of the link whose frame they have;
    `of`: for each link the name of its carrier, or the world; `links` by their names; `chains`.
    """

    carriers: dict[LinkKey, Link]
    of: dict[LinkKey, LinkKey]
    links: dict[LinkKey, Link]
    chains: list[Chain]

    def placed(self, link: LinkKey) -> PlacedLink:
        """The body of a link, at the reference pose."""
        carrier = self.of[link]
        if carrier is WORLD:
            return PlacedLink(GROUND, np.zeros(3), np.eye(3))
        body = self.carriers[carrier]
        return PlacedLink(body.name, body.position, body.rotation)

    def point(self, link: LinkKey, at: np.ndarray) -> tuple[str, np.ndarray]:
        """The body of a link, and a point of the link in that body's frame."""
        body = self.placed(link)
        if self.of[link] == link:
            return body.name, at
        placement = self.links[link]
        return body.name, body.point(placement.position + placement.rotation @ at)

    def rotation(self, link: LinkKey) -> np.ndarray:
        """The rotation matrix from a link's axes to its body's."""
        body = self.placed(link)
        if self.of[link] == link:
            return np.eye(3)
        return body.rotation.T @ self.links[link].rotation

    def frames(self) -> dict[str, tuple[str, np.ndarray, np.ndarray]]:
        """For each link that is fixed to another link: its body, and its position and rotation in the body."""
        out = {}
        for name, carrier in self.of.items():
            if name is not WORLD and carrier != name and (carrier is WORLD or carrier in self.carriers):
                out[name] = *self.point(name, np.zeros(3)), self.rotation(name)
        return out

    def moved_inertia(self, joint: Joint) -> float:
        """The inertia [kg m²] or mass [kg] that moves with a joint, with all other joints held; in a closed loop only
        the next body's.
        """
        start, blocked = self.of[joint.child], self.of[joint.parent]
        seen, queue = {start}, [start]
        while queue:
            body = queue.pop()
            for chain in self.chains:
                ends = self.of[chain.parent], self.of[chain.child]
                if joint in chain.joints or body not in ends:
                    continue
                other = ends[1] if ends[0] == body else ends[0]
                if other in (WORLD, blocked):
                    seen, queue = {start}, []
                    break
                if other not in seen:
                    seen.add(other)
                    queue.append(other)
        links = [self.carriers[name] for name in seen if name in self.carriers]
        if joint.kind == "slide":
            return sum(link.mass for link in links)
        return sum(_about(link, joint) for link in links)


def _about(link, joint):
    axis = link.rotation.T @ joint.axis
    arm = np.cross(joint.axis, link.position + link.rotation @ link.centre - joint.point)
    return float(axis @ link.inertia @ axis + link.mass * arm @ arm)


def fuse(machine: Machine, notes: Notes) -> Fused:
    """Fuse links that are fixed to each other, later links of the file to earlier links."""
    links: dict[LinkKey, Link] = {WORLD: Link(GROUND), **machine.links}
    of = bodies_of(machine)
    groups = {name: [links[key] for key in links if of[key] == name] for name in dict.fromkeys(of.values())}
    moving = [joint for joint in machine.joints if joint.kind != "fixed"]
    weighs = lambda link: link.mass or np.any(link.inertia)
    light = {name for name, group in groups.items() if name is not WORLD and not any(weighs(link) for link in group)}
    chains = _chains(moving, of, light, links, notes)
    heavy = [name for name in groups if name is not WORLD and name not in light]
    carriers: dict[LinkKey, Link] = {name: _summed(links[name], groups[name]) for name in heavy}
    return Fused(carriers, of, links, chains)


def _chains(joints, of, light, links, notes):
    """Joints in succession between bodies with mass."""
    at: dict[LinkKey, list[Joint]] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            at.setdefault(of[link], []).append(joint)
    for name in sorted(light, key=list(links).index):
        if len(at.get(name, [])) != 2:
            ends = "carries nothing" if len(at.get(name, [])) < 2 else "branches"
            notes.refused.append(
                f"{links[name].where}Link {name!r} moves without mass and {ends}: give it a mass and an inertia, or "
                "fix it to another link."
            )
    out = []
    for joint in joints:
        if of[joint.parent] in light:
            continue
        chain, end = [joint], joint.child
        while of[end] in light and len(chain) <= len(joints):
            following = [
                candidate for candidate in at[of[end]] if candidate is not chain[-1] and of[candidate.parent] == of[end]
            ]
            if not following:
                break
            chain.append(following[0])
            end = following[0].child
        if of[end] not in light:
            out.append(Chain(chain, joint.parent, end))
    return out


def _summed(frame: Link, links: list[Link]) -> Link:
    """Several links as one, in the frame of the link `frame`."""
    mass = sum(link.mass for link in links)
    if len(links) == 1 or not mass:
        return dataclasses.replace(frame)
    centres = [frame.rotation.T @ (link.position + link.rotation @ link.centre - frame.position) for link in links]
    centre = sum(link.mass * place for link, place in zip(links, centres, strict=True)) / mass
    inertia = np.zeros((3, 3))
    for link, place in zip(links, centres, strict=True):
        turn, arm = frame.rotation.T @ link.rotation, place - centre
        inertia += turn @ link.inertia @ turn.T + link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return dataclasses.replace(frame, mass=mass, centre=centre, inertia=inertia)
