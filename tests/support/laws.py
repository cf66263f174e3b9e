"""Every terrain, and every law of the normal force and of the friction of contact."""

import jax.numpy as jnp

from jaxmb.parts import contact, terrain

BUMP = terrain.Bump(start=4.0, length=1.5, peak=0.12)
TERRAINS = {
    "flat": terrain.Flat(0.3),
    "bump": BUMP,
    "sinusoid": terrain.Sinusoid(amplitude=0.1, wavelength=2.0, phase=0.4),
    "slope": terrain.Slope(-0.2, level=1.0),
    "ramp": terrain.Ramp(start=3.0, length=2.0, rise=-0.5),
    "spline": terrain.Spline(x=[3.0, 3.5, 4.5, 5.0, 6.0], heights=[0.0, 0.2, -0.1, 0.1, 0.1]),
    "surface": terrain.Surface(lambda x, p: p["a"] * jnp.cos(x[0]), parameters={"a": 0.2}),
}
LAWS = {
    "linear": contact.Linear(8e4),
    "hertz": contact.Hertz(3e5),
    "soft soil": contact.Bekker(cohesive_modulus=2e3, frictional_modulus=8e5, exponent=0.7, width=0.3, area=0.05),
}
JANOSI = contact.Janosi(
    cohesion=3e3, friction_angle=0.5, shear_modulus=0.02, length=0.4, area=0.1, transition_speed=0.05
)
FRICTION = {"coulomb": contact.Coulomb(0.7, transition_speed=0.3), "janosi": JANOSI}
