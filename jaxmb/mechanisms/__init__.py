# ruff: noqa: I001
"""A library of mechanisms with their sources and reference values; `names()` lists them, `get(name)` builds one.

```python
machine = jaxmb.mechanisms.get("four_bar", speed=4.0)  # Or jaxmb.mechanisms.four_bar(speed=4.0).
ts = machine.references.times
motion = jaxmb.simulate(machine.system, machine.state, t1=machine.t1, saveat=ts)
machine.observe(motion)["crank"], machine.errors(motion)["crank"]
len(jaxmb.mechanisms.names())
```
"""

from collections.abc import Callable
from typing import Any

from ..parts.names import unknown

## Library
from .mechanism import Mechanism as Mechanism, References as References
from ._shoe_track import Shoes as Shoes
from . import ride as ride

## Rigid bodies in the plane
from .pendulum import pendulum as pendulum
from .rod_chain import rod_chain as rod_chain
from .train import train as train
from .longitudinal_train import longitudinal_train as longitudinal_train
from .hanging_chain import hanging_chain as hanging_chain
from .tree import tree as tree
from .four_bar import four_bar as four_bar
from .stiff_four_bar import stiff_four_bar as stiff_four_bar
from .slider_crank import slider_crank as slider_crank
from .parallelogram import parallelogram as parallelogram
from .n_four_bar import n_four_bar as n_four_bar
from .andrews import andrews as andrews
from .car_axis import car_axis as car_axis
from .tracked_vehicle import tracked_vehicle as tracked_vehicle
from .knife_edge import knife_edge as knife_edge
from .chaplygin_sleigh import chaplygin_sleigh as chaplygin_sleigh

## Rigid bodies in space
from .free_body import free_body as free_body
from .heavy_top import heavy_top as heavy_top
from .cable import cable as cable
from .net import net as net
from .spatial_slider_crank import spatial_slider_crank as spatial_slider_crank
from .spatial_loop import spatial_loop as spatial_loop
from .bricard import bricard as bricard
from .bennett import bennett as bennett
from .swash_plate import swash_plate as swash_plate
from .double_wishbone import double_wishbone as double_wishbone
from .five_link import five_link as five_link
from .flyball import flyball as flyball
from .rolling_disc import rolling_disc as rolling_disc

## From a Lagrangian
from .roller_racer import roller_racer as roller_racer
from .nonholonomic_cart import nonholonomic_cart as nonholonomic_cart
from .three_platform_snake import three_platform_snake as three_platform_snake
from .appell_hamel import appell_hamel as appell_hamel
from .constant_speed_particle import constant_speed_particle as constant_speed_particle
from .benenti import benenti as benenti
from .rough_ring import rough_ring as rough_ring
from .tracking_chain import tracking_chain as tracking_chain
from .spherical_four_bar import spherical_four_bar as spherical_four_bar

# The functions decorated as mechanisms.
_LIBRARY: dict[str, Callable[..., Mechanism]] = {
    name: function for name, function in globals().items() if hasattr(function, "__wrapped__")
}


## Library
def names() -> tuple[str, ...]:
    """The names of all mechanisms, rigid bodies in the plane first, then in space, then systems from a Lagrangian."""
    return tuple(_LIBRARY)


def get(name: str, **parameters: Any) -> Mechanism:
    """Build a mechanism by name.

    **Arguments:** `name`, one of `names()`; `parameters` of that mechanism, by keyword.

    **Raises:** `ValueError` for an unknown name, with the nearest name, and for an unknown parameter.
    """
    if name not in _LIBRARY:
        raise unknown("mechanism", name, names())
    return _LIBRARY[name](**parameters)
