"""Time and error of an optimal control problem, beside dymos where it is installed: `python tests/benchmarks/plans.py`.

A cart of 1 kg swings up a pole of 0.5 m with 0.3 kg at its end, in 2 s and over 1 m, with the least ∫ F² dt. The exact
objective of the published optimum is 58.80766746: Pontryagin's equations, solved by `scipy.integrate.solve_bvp`.

Source: M. Kelly, "An Introduction to Trajectory Optimization", SIAM Review 59(4), 2017.
"""

import time

import numpy as np

EXACT = 58.80766746
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
    runs = [("jaxmb, 20 cubic intervals", by_jaxmb)]
    try:
        import dymos  # noqa: F401

        for segments, order in ((10, 3), (20, 3)):
            runs.append((f"dymos, {segments} segments of order {order}", lambda a=segments, b=order: by_dymos(a, b)))
    except ImportError:
        print("dymos is not installed: pip install dymos")
    print(f"{'':34}{'first [s]':>10}{'next [s]':>10}{'error':>10}")
    for name, run in runs:
        first, later, objective = run()
        print(f"{name:34}{first:10.2f}{later:10.2f}{abs(objective / EXACT - 1):10.1e}", flush=True)


if __name__ == "__main__":
    main()
