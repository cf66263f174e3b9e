"""Time and error of an optimal control problem, beside dymos where it is installed: `python tests/benchmarks/plans.py`.

A cart of 1 kg swings up a pole of 0.5 m with 0.3 kg at its end, in 2 s and over 1 m, with the least ∫ F² dt. The exact
objective of the published optimum is 58.80766746: Pontryagin's equations, solved by `scipy.integrate.solve_bvp`.

A four-bar linkage turns its crank by half a turn in 2 s, with the least ∫ τ² dt: the time of a plan, and of a gradient
of one motion of the same machine. The exact objective is 18.987353952.

Source: M. Kelly, "An Introduction to Trajectory Optimization", SIAM Review 59(4), 2017.
"""

import time

import numpy as np

EXACT, OF_LINKAGE = 58.80766746, 18.987353952
CART, BOB, LENGTH, GRAVITY = 1.0, 0.3, 0.5, 9.81


def by_jaxmb():
    """Seconds of the first plan, with compiling, and of the next one; the objective."""
    import jaxmb as mb
    from jaxmb import planar

    mb.setup(keep=False)
    cart = planar.Body("cart", mass=CART, inertia=1.0)
    pole = planar.Body("pole", mass=BOB, inertia=1e-12, position=(0.0, -LENGTH))
    slide = planar.Prismatic("slide", "ground", "cart", point=(0.0, 0.0), axis=(1.0, 0.0))
    hinge = planar.Revolute("hinge", "cart", "pole", point_a=(0.0, 0.0), point_b=(0.0, LENGTH))
    forces = [mb.Gravity((0.0, -GRAVITY)), mb.JointForce("push", "slide.displacement", force=0.0)]
    system = mb.Scene([cart, pole], joints=[slide, hinge], forces=forces).compile()
    names = ("slide.displacement", "slide.displacement_rate", "hinge.angle", "hinge.angle_rate")
    start, end = (dict(zip(names, x, strict=True)) for x in ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, np.pi, 0.0)))
    seconds, objective = [], 0.0
    for _ in range(2):
        begin = time.perf_counter()
        plan = mb.plan(
            system,
            controls={"push.force": (-20.0, 20.0)},
            duration=2.0,
            start=start,
            end=end,
            running="effort",
            interpolation="cubic",
            intervals=20,
        )
        seconds.append(time.perf_counter() - begin)
        objective = plan.objective
    return *seconds, objective


def linkage():
    """A four-bar linkage with a motor on its crank, without gravity."""
    import jaxmb as mb
    from jaxmb import mechanisms

    mb.setup(keep=False)
    bars = {"lengths": (1.0, 2.0, 1.8), "base": 2.5, "masses": (1.0, 1.0, 1.0), "gravity": 0.0, "angle": 1.57}
    motor = mb.JointForce("motor", "A.angle", force=0.0)
    return mechanisms.four_bar(**bars).scene.extended(forces=[motor]).compile()


def by_plan():
    """Seconds of the first plan of the linkage, with compiling, and of the next one; the objective."""
    import jaxmb as mb

    system, seconds, objective = linkage(), [], 0.0
    start, end = ({"crank.angle": angle, "crank.angle_rate": 0.0} for angle in (1.57, 1.57 + np.pi))
    options = {"controls": {"motor.force": None}, "duration": 2.0, "running": "effort", "intervals": 32}
    for _ in range(2):
        begin = time.perf_counter()
        objective = mb.plan(system, start=start, end=end, **options).objective
        seconds.append(time.perf_counter() - begin)
    return *seconds, objective


def by_gradient():
    """Seconds of the first gradient of a motion of the linkage by the torque, with compiling, and of the next one."""
    import jax

    import jaxmb as mb

    system, seconds = linkage(), []
    state = mb.assemble(system)

    def turned(torque):
        driven = mb.with_parameters(system, {"motor.force": torque})
        return mb.simulate(driven, state, t1=2.0, rtol=1e-8).ys.q[-1, 2]

    slope = jax.jit(jax.grad(turned))
    for torque in (0.5, 0.6):
        begin = time.perf_counter()
        jax.block_until_ready(slope(torque))
        seconds.append(time.perf_counter() - begin)
    return *seconds, float("nan")


def by_dymos(segments, order):
    """As `by_jaxmb`, by collocation at Radau's points and SciPy's SLSQP, with derivatives by complex steps."""
    import dymos as dm
    import openmdao.api as om

    class CartPole(om.ExplicitComponent):
        def initialize(self):
            self.options.declare("num_nodes", types=int)

        def setup(self):
            n = self.options["num_nodes"]
            for name, unit in {"angle": "rad", "rate": "rad/s", "force": "N"}.items():
                self.add_input(name, np.zeros(n), units=unit)
            for name, unit in {"acceleration": "m/s**2", "turning": "rad/s**2", "cost": "N**2"}.items():
                self.add_output(name, np.zeros(n), units=unit)
            rows = np.arange(n)
            self.declare_partials("*", "*", rows=rows, cols=rows, method="cs")

        def compute(self, inputs, outputs):
            angle, rate, force = (inputs[name] for name in ("angle", "rate", "force"))
            sine, cosine = np.sin(angle), np.cos(angle)
            down = CART + BOB * (1 - cosine**2)
            outputs["acceleration"] = (force + BOB * sine * (LENGTH * rate**2 + GRAVITY * cosine)) / down
            whole = (CART + BOB) * GRAVITY * sine
            outputs["turning"] = -(force * cosine + BOB * LENGTH * rate**2 * cosine * sine + whole) / (LENGTH * down)
            outputs["cost"] = force**2

    begin = time.perf_counter()
    problem = om.Problem(reports=False)
    problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-9, maxiter=500, disp=False)
    phase = dm.Phase(ode_class=CartPole, transcription=dm.Radau(num_segments=segments, order=order, compressed=True))
    motion = dm.Trajectory()
    motion.add_phase("phase", phase)
    problem.model.add_subsystem("motion", motion)
    phase.set_time_options(fix_initial=True, fix_duration=True, initial_val=0.0, duration_val=2.0)
    fixed = {"fix_initial": True, "fix_final": True, "shape": (1,)}
    phase.add_state("x", rate_source="speed", units="m", **fixed)
    phase.add_state("angle", rate_source="rate", targets=["angle"], units="rad", **fixed)
    phase.add_state("speed", rate_source="acceleration", units="m/s", **fixed)
    phase.add_state("rate", rate_source="turning", targets=["rate"], units="rad/s", **fixed)
    phase.add_state("effort", fix_initial=True, shape=(1,), rate_source="cost", units="N**2*s", ref=50.0)
    phase.add_control("force", lower=-20.0, upper=20.0, targets=["force"], units="N", ref=10.0)
    phase.add_objective("effort", loc="final", ref=50.0)
    problem.setup()
    for name, values in {"x": [0, 1], "angle": [0, np.pi], "speed": [0, 0], "rate": [0, 0], "effort": [0, 50]}.items():
        phase.set_state_val(name, values)
    phase.set_control_val("force", [0.0, 0.0])
    problem.run_driver()
    first = time.perf_counter() - begin
    return first, first, float(problem.get_val("motion.phase.timeseries.effort")[-1, 0])


def main():
    runs = [("jaxmb, 20 cubic intervals", by_jaxmb, EXACT)]
    try:
        import dymos  # noqa: F401

        for segments, order in ((10, 3), (20, 3)):
            name = f"dymos, {segments} segments of order {order}"
            runs.append((name, lambda a=segments, b=order: by_dymos(a, b), EXACT))
    except ImportError:
        print("dymos is not installed: pip install dymos")
    runs.append(("jaxmb, linkage, 32 intervals", by_plan, OF_LINKAGE))
    runs.append(("jaxmb, linkage, a gradient", by_gradient, OF_LINKAGE))
    print(f"{'':34}{'first [s]':>10}{'next [s]':>10}{'error':>10}")
    for name, run, exact in runs:
        first, later, objective = run()
        print(f"{name:34}{first:10.2f}{later:10.2f}{abs(objective / exact - 1):10.1e}", flush=True)


if __name__ == "__main__":
    main()
