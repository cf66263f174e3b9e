"""A library of mechanisms with their sources and reference values; `names()` lists them, `get(name)` builds one.

```python
machine = jaxmb.mechanisms.get("four_bar", speed=4.0)  # Or jaxmb.mechanisms.four_bar(speed=4.0).
ts = machine.references.times
motion = jaxmb.simulate(machine.system, machine.state, t1=machine.t1, saveat=ts)
machine.observe(motion)["crank"], machine.errors(motion)["crank"]
len(jaxmb.mechanisms.names())
```
"""

from typing import Any

from ..parts.names import unknown
from . import ride as ride
from ._shoe_track import Shoes as Shoes
from .andrews import andrews as andrews
from .appell_hamel import appell_hamel as appell_hamel
from .benenti import benenti as benenti
from .bennett import bennett as bennett
from .bricard import bricard as bricard
from .cable import cable as cable
from .car_axis import car_axis as car_axis
from .chaplygin_sleigh import chaplygin_sleigh as chaplygin_sleigh
from .constant_speed_particle import constant_speed_particle as constant_speed_particle
from .double_wishbone import double_wishbone as double_wishbone
from .flyball import flyball as flyball
from .four_bar import four_bar as four_bar
from .free_body import free_body as free_body
from .hanging_chain import hanging_chain as hanging_chain
from .heavy_top import heavy_top as heavy_top
from .knife_edge import knife_edge as knife_edge
from .longitudinal_train import longitudinal_train as longitudinal_train
from .mechanism import Mechanism as Mechanism, References as References
from .n_four_bar import n_four_bar as n_four_bar
from .net import net as net
from .nonholonomic_cart import nonholonomic_cart as nonholonomic_cart
from .parallelogram import parallelogram as parallelogram
from .pendulum import pendulum as pendulum
from .rod_chain import rod_chain as rod_chain
from .roller_racer import roller_racer as roller_racer
from .rolling_disc import rolling_disc as rolling_disc
from .rough_ring import rough_ring as rough_ring
from .slider_crank import slider_crank as slider_crank
from .spatial_loop import spatial_loop as spatial_loop
from .spatial_slider_crank import spatial_slider_crank as spatial_slider_crank
from .spherical_four_bar import spherical_four_bar as spherical_four_bar
from .stiff_four_bar import stiff_four_bar as stiff_four_bar
from .swash_plate import swash_plate as swash_plate
from .three_platform_snake import three_platform_snake as three_platform_snake
from .tracked_vehicle import tracked_vehicle as tracked_vehicle
from .tracking_chain import tracking_chain as tracking_chain
from .train import train as train
from .tree import tree as tree

_LIBRARY = {
    function.__name__: function
    for function in (
        pendulum,
        rod_chain,
        train,
        longitudinal_train,
        hanging_chain,
        tree,
        four_bar,
        stiff_four_bar,
        slider_crank,
        parallelogram,
        n_four_bar,
        andrews,
        car_axis,
        tracked_vehicle,
        knife_edge,
        chaplygin_sleigh,
        free_body,
        heavy_top,
        cable,
        net,
        spatial_slider_crank,
        spatial_loop,
        bricard,
        bennett,
        swash_plate,
        double_wishbone,
        flyball,
        rolling_disc,
        roller_racer,
        nonholonomic_cart,
        three_platform_snake,
        appell_hamel,
        constant_speed_particle,
        benenti,
        rough_ring,
        tracking_chain,
        spherical_four_bar,
    )
}


def names() -> tuple[str, ...]:
    """The names of all mechanisms, rigid bodies in the plane first, then in space, then systems from a Lagrangian."""
    return tuple(_LIBRARY)


def get(name: str, **parameters: Any) -> Mechanism:
    """Build a mechanism by name.

    **Arguments:** `name`, one of `names()`; `parameters` of that mechanism, by keyword.

    **Raises:** `ValueError` for an unknown name, with the nearest one, and for an unknown parameter.
    """
    if name not in _LIBRARY:
        raise unknown("mechanism", name, names())
    return _LIBRARY[name](**parameters)
