"""Public names: each has one entry with a docstring, and is found by what users call it."""

import importlib
import inspect

import pytest

import jaxmb as mb
from jaxmb.reference import find, listed, shown, shown_topic, subjects, topics
from jaxmb.reference.entries import entries, public_modules, public_names, results, signature

MODULES = {"": mb, **public_modules()}


def test_entries_of_public_names_are_one_each():
    assert set(public_modules()) == {name for name, own in entries().items() if own.kind == "module"}
    things = [id(entry.thing) for entry in entries().values()]
    assert len(things) == len(set(things))
    for path, module in MODULES.items():
        for name in public_names(module):
            thing = getattr(module, name)
            is_own = getattr(thing, "__module__", "").startswith("jaxmb")
            if is_own and (inspect.isclass(thing) or inspect.isroutine(thing)):
                assert find(f"{path}.{name}".lstrip(".")).thing is thing


def test_subjects_are_headings():
    headings = [subject.title for subject in subjects() if subject.module is None]
    assert headings[0] == "Scenes and their numbers" and "Sweeps" in headings
    (planar,) = [subject for subject in subjects() if subject.title == "jaxmb.planar"]
    assert [*planar.groups] == ["Bodies", "Joints", "Forces", "Ground and contact"]
    assert "KnifeEdge" in [entry.short for entry in planar.groups["Joints"]]


def test_entries_are_not_private():
    for entry in entries().values():
        assert not any(word.startswith("_") for word in entry.name.split("."))


def test_topics_hide_no_public_name():
    for topic in topics():
        # Unknown, or of several modules, as `names` is.
        with pytest.raises(ValueError, match=r"Unknown name|is the name of"):
            find(topic)


def test_links_of_topics_are_words_in_a_terminal():
    text = shown_topic(topics()["examples"])
    assert "| 20_ropes |" in text and "right, sweeps, large" in " ".join(text.split()) and ".ipynb" not in text


def test_entries_have_docstrings():
    for subject in subjects():
        for entry in (*subject.entries, *([subject.module] if subject.module else [])):
            # That of a dataclass without one is its signature.
            assert entry.text and not entry.text.startswith(f"{entry.short}("), entry.name
            assert entry.summary.endswith((".", ":")) and "\n" not in entry.summary, entry.summary


def test_entries_are_found_by_what_users_call_them():
    for given, name in (
        ("simulate", "simulate"),
        ("mb.simulate()", "simulate"),
        ("four_bar", "mechanisms.four_bar"),
        ("spatial.Contact", "planar.Contact"),
        ("parts.AbstractTerrain", "terrain.AbstractTerrain"),
        ("Trajectory.reactions", "Trajectory.reactions"),
        ("planar.Revolute.anchor", "parts.AbstractLink.anchor"),
        ("Adams.min_order", "solvers.Adams.min_order"),
        ("solvers", "solvers"),
    ):
        assert find(given).name == name
    for given, message in (
        ("simulat", "did you mean 'simulate'"),
        ("planar.Revolut", "did you mean 'planar.Revolute'"),
        ("Trajectory.reaction", "did you mean 'Trajectory.reactions'"),
        ("Revolute", "'Revolute' is the name of 'planar.Revolute' and 'spatial.Revolute'; give one of these."),
    ):
        with pytest.raises(ValueError, match=message):
            find(given)


def test_entries_of_classes_that_public_names_return():
    for given, name, text in (
        ("PartMotion", "trajectory.PartMotion", "The measurable quantities of a joint or a frame along a motion"),
        ("jaxmb.Reaction", "system.quantities.Reaction", "The force that a joint exerts on its last body"),
        ("HeldOut", "studies.identify.prediction.HeldOut", "The quality of prediction"),
        ("Mode", "studies.linear.linearisation.Mode", ""),
    ):
        entry = find(given)
        assert entry.name == name and text in shown(entry)
        module, _, short = f"jaxmb.{name}".rpartition(".")
        assert getattr(importlib.import_module(module), short) is entry.thing


def test_entries_of_every_class_in_the_annotation_of_a_public_result():
    assert {"Quantity", "ConstraintViolation", "Prediction", "Reaction"} <= results().keys()
    for name, entry in results().items():
        assert find(name) is entry and entry.kind == "class" and not entry.short.startswith("_")
    with pytest.raises(mb.UnknownNameError, match="did you mean 'Reaction'"):
        find("Reactoin")


def test_signatures_are_those_of_the_source():
    written = lambda name: {key: str(own) for key, own in signature(find(name)).parameters.items()}
    assert written("State")["q"] == "q: Float[Array, '... nq']"
    # A constant is shown by its value.
    assert written("simulate")["rtol"] == "rtol: Scalar = 1e-08"
    assert str(signature(find("simulate"))).endswith("-> Trajectory")
    # Fields of base classes, and a constructor that is written.
    assert [*written("planar.Revolute").values()][:3] == ["name: str", "body_a: str", "body_b: str"]
    assert written("planar.Track")["path"] == "path: Sequence[tuple[str, VectorLike]]"
    assert str(signature(find("Trajectory.at"))) == "(t: ArrayLike) -> State"
    assert signature(find("Trajectory.energy")) is None


def test_shown_text_for_a_terminal():
    text = shown(find("simulate"), width=60)
    assert text.startswith("jaxmb.simulate(\n    system: AbstractSystem,\n    state: State,\n    *,\n    t1: Scalar,\n")
    # Code is not broken into lines; what follows it is.
    code = "    motion = jaxmb.simulate(system, state, t1=1.0, saveat=np.linspace(0.0, 1.0, 11))"
    assert code in text.splitlines()
    prose = text[text.index("\nMain arguments:\n\n- `system`") :].splitlines()
    assert max(map(len, prose)) <= 60 and "**" not in text and "```" not in text


def test_shown_text_with_styles():
    text = shown(find("planar.rod"), styled=True)
    assert text.startswith("\x1b[1mjaxmb.planar.rod\x1b[0m(") and "`" not in text and "\x1b[36m" in text


def test_listed_names_are_all():
    text, short = listed(width=200, every=True), listed(width=10_000)
    for subject in subjects():
        assert (subject.title in text.splitlines()) == (subject.title in short.splitlines()) == bool(subject.entries)
        for entry in subject.entries:
            assert f"\n  {entry.name}  {entry.summary[:40]}" in text
        assert not subject.entries or f"\n  {', '.join(entry.short for entry in subject.entries)}" in short
    assert len(listed(width=100).splitlines()) < len(text.splitlines()) / 3


def test_shown_contents_of_a_module_and_a_class():
    module = shown(find("spatial"))
    assert "\nJoints\n" in module and "  spatial.Revolute  A hinge" in module
    assert "\nOf other modules\n" in module and "  planar.Contact  Contact of bodies" in module
    of_class = shown(find("Scene"))
    assert "\nMethods and properties\n" in of_class and "  compile  " in of_class
    assert "From parts.AbstractLink\n" in shown(find("planar.Revolute"), every=True)
    assert "AbstractLink" not in shown(find("planar.Revolute"))
