"""Plausible errors of a programmer, one for each law, sign, limit, branch, rule and phase of the package.

A fault has a file of the package, code that occurs once in it, and the code with the fault, of as many lines. It
changes numbers or words that a user sees, and raises nothing. `seeded_faults.py` tries which tests notice it.
"""

from fault_switch import Fault

FAULTS = [
    # Parts: forces, drives and joints
    Fault("parts/actuators.py", "* control + jnp.dot(self.bias, terms)", "* control - jnp.dot(self.bias, terms)"),
    Fault(
        "parts/actuators.py",
        "self.gear * self.force(self.gear * x[0], self.gear * v[0])",
        "self.force(self.gear * x[0], self.gear * v[0])",
    ),
    Fault("parts/actuators.py", "return _clipped(force, self.force_range)", "return force"),
    Fault(
        "parts/actuators.py",
        "self.shortest_difference(x, self.command) - self.damping * v",
        "self.shortest_difference(x, self.command) + self.damping * v",
    ),
    Fault(
        "parts/actuators.py",
        "(self._clipped_control() - self.activation) / self.lag",
        "(self._clipped_control() - self.activation) * self.lag",
    ),
    Fault("parts/beam.py", "rot.rotate_2d(-start - turn / 2,", "rot.rotate_2d(-start - turn,"),
    Fault("parts/beam.py", "rot.unrotate(half, in_a)", "rot.unrotate(turn, in_a)"),
    Fault("parts/beam.py", "(strain + self.damping_time * rate)", "(strain - self.damping_time * rate)"),
    Fault("parts/beam.py", "-self.length * law(x, v)", "-law(x, v)"),
    Fault("parts/beam.py", "return -self.length * self.deformations", "return self.length * self.deformations"),
    Fault("parts/beam.py", '"section_moment": moment.reshape', '"section_moment": -moment.reshape'),
    Fault("parts/beam.py", "self.length**2 / (12 *", "self.length**2 / (6 *"),
    Fault("parts/beam_chain.py", "masses * lengths**2 / 12)", "masses * lengths**2 / 3)"),
    Fault("parts/beam_chain.py", "out = np.convolve(masses, (0.5, 0.5))", "out = np.convolve(masses, (1.0, 0.0))"),
    Fault("parts/beam_chain.py", "both / (12 * l[1])", "both / (6 * l[1])"),
    Fault("parts/sections.py", "10 * (1 + self.poisson_ratio)", "12 * (1 + self.poisson_ratio)"),
    Fault("parts/sections.py", "[torsion, y * z**3 / 12, z * y**3 / 12]", "[torsion, z * y**3 / 12, y * z**3 / 12]"),
    Fault("parts/sections.py", "sums = _ODD_SUM - xp.sum", "sums = _ODD_SUM + xp.sum"),
    Fault(
        "parts/bushing.py",
        "law = lambda x, v: -self.stiffness * x - self.damping * v",
        "law = lambda x, v: -self.stiffness * x",
    ),
    Fault(
        "parts/combinations.py",
        "polynomial = polynomial * y + powers[k]",
        "polynomial = polynomial * y + k * powers[k]",
    ),
    Fault("parts/combinations.py", "out = (poses[-1, 0] - value)[None]", "out = (poses[-1, 0] - 2 * value)[None]"),
    Fault(
        "parts/combinations.py", "values[k] = values[k] + turns(poses[count, 0] - values[k])", "values[k] = values[k]"
    ),
    Fault("parts/combinations.py", "return norm(points[1:] - points[:-1])", "return norm(points[1:] - points[:1])"),
    Fault(
        "parts/controller.py",
        "return rate_of(space, self, coordinate, poses, velocities)[1]",
        "return rate_of(space, self, coordinate, poses, velocities)[0]",
    ),
    Fault(
        "parts/controller.py",
        "frame.pose(space, pose, *zeta), frame.velocity(space, pose, velocity, *zeta, *rates)",
        "frame.pose(space, pose, *zeta), velocity",
    ),
    Fault(
        "parts/coordinate_parts.py",
        "-self.stiffness * self._stretch(x) - self.damping * v",
        "-self.stiffness * self._stretch(x) + self.damping * v",
    ),
    Fault(
        "parts/coordinate_parts.py",
        "return self.force.reshape(-1)",
        "return -self.force.reshape(-1)",
    ),
    Fault("parts/coordinate_parts.py", "return self.value + self.rate * t", "return self.value"),
    Fault(
        "parts/coordinate_parts.py",
        "[value - self.lower, self.upper - value]",
        "[value - self.lower, self.upper + value]",
    ),
    Fault(
        "parts/coordinate_parts.py", "self.exponent + 1)) / (self.exponent + 1)", "self.exponent + 1)) / self.exponent"
    ),
    Fault(
        "parts/dry_friction.py",
        "jnp.tanh(v / self.transition_speed))",
        "jnp.tanh(v * self.transition_speed))",
    ),
    Fault("parts/coordinate_parts.py", "jnp.round(angle / (2 * np.pi))", "jnp.floor(angle / (2 * np.pi))"),
    Fault("parts/cylinder.py", "push - self.rod_pressure * self.rod_area", "push + self.rod_pressure * self.rod_area"),
    Fault(
        "parts/distance.py",
        "dot(d, d) - self.length**2) / (2 * self.length)",
        "dot(d, d) - self.length**2) / self.length",
    ),
    Fault("parts/drivers.py", "return -pull(multipliers)[0].reshape(-1)", "return pull(multipliers)[0].reshape(-1)"),
    Fault(
        "parts/drivers.py",
        "s * jnp.cos(value) - c * jnp.sin(value), c * jnp.cos(value)",
        "s * jnp.cos(value) + c * jnp.sin(value), c * jnp.cos(value)",
    ),
    Fault(
        "parts/drivers.py",
        'offset_in_a(space, self, poses)["xyz".index(self.quantity)]',
        'separation(space, self, poses)["xyz".index(self.quantity)]',
    ),
    Fault("parts/forces.py", "* d - self.damping * along", "* d + self.damping * along"),
    Fault("parts/forces.py", "- 2 * self.free_length * norm(d)", "- self.free_length * norm(d)"),
    Fault(
        "parts/forces.py",
        "force_pair(space, self, poses, -self.damping * rate)",
        "force_pair(space, self, poses, self.damping * rate)",
    ),
    Fault("parts/forces.py", "space.direction(poses[0], self.force)\n", "space.body_direction(poses[0], self.force)\n"),
    Fault(
        "parts/forces.py",
        'turns_along = self.frame == "body" and space.dimension == 3',
        'turns_along = self.frame == "world" and space.dimension == 3',
    ),
    Fault("parts/forces.py", "-self.damping * (omega_b - omega_a)", "-self.damping * omega_b"),
    Fault(
        "parts/forces.py",
        "lambda part: -part.terrain.height(point[:-1])",
        "lambda part: part.terrain.height(point[:-1])",
    ),
    Fault(
        "parts/frames.py",
        "return space.point_force(pose, -self.centre, wrench[:d]) + moment",
        "return space.point_force(pose, self.centre, wrench[:d]) + moment",
    ),
    Fault(
        "parts/functions.py",
        "return _shaped(self, value, reactions.shape)",
        "return -_shaped(self, value, reactions.shape)",
    ),
    Fault(
        "parts/functions.py",
        "self.potential(poses[:, : space.pose_size], t, self.parameters), ())",
        "self.potential(poses[:, : space.pose_size], 0 * t, self.parameters), ())",
    ),
    Fault(
        "parts/functions.py",
        "value = self.function(poses[:, : space.pose_size], velocities, t, self.parameters)\n        return",
        "value = self.function(poses[:, : space.pose_size], velocities, 0 * t, self.parameters)\n        return",
    ),
    Fault(
        "parts/kinks.py",
        "jnp.where(x < low, low, jnp.where(x > high, high, x))",
        "jnp.where(x <= low, low, jnp.where(x >= high, high, x))",
    ),
    Fault("parts/knife_edge.py", "ahead[0] * v[1] - ahead[1] * v[0]", "ahead[0] * v[1] + ahead[1] * v[0]"),
    Fault("parts/knife_edge.py", "dot(cross(self.normal, ahead), v)", "dot(ahead, v)"),
    Fault("parts/local_spline.py", "inside += a * s * r**3 * (1 + 3 * s)", "inside += a * s * r**3 * (1 + 2 * s)"),
    Fault("parts/local_spline.py", "before * (y[0] + 0.5 * before * first)", "before * (y[0] + before * first)"),
    Fault(
        "parts/names.py", "{' or '.join(map(repr, near))}?\" if near", "{' or '.join(map(repr, near))}?\" if not near"
    ),
    Fault(
        "parts/series.py",
        "h * s * (1 - s) * (before * (1 - s) + after * s)",
        "h * s * (1 - s) * (before * s + after * (1 - s))",
    ),
    Fault(
        "parts/series.py",
        "jnp.where(t >= ts[-1], values[-1], values[k])",
        "jnp.where(t >= ts[-1], values[-1], values[k + 1])",
    ),
    Fault(
        "parts/series.py",
        "inner = 3 * (h[1:] * chords[:-1] + h[:-1] * chords[1:])",
        "inner = 3 * (h[:-1] * chords[:-1] + h[1:] * chords[1:])",
    ),
    Fault("parts/smooth.py", "series = 1 - square * (1 / 3 - square", "series = 1 - square * (1 / 2 - square"),
    Fault("parts/smooth.py", "return jnp.where(damping > -load, damping, -load)", "return damping"),
    Fault("parts/smooth.py", "10 + s * (6 * s - 15)", "10 + s * (6 * s - 10)"),
    Fault("parts/space.py", "forces = jnp.stack([-force_W, force_W])", "forces = jnp.stack([0 * force_W, force_W])"),
    Fault("parts/space.py", "space.moment(poses[0], -moment_W)", "space.moment(poses[0], moment_W)"),
    Fault(
        "parts/space.py",
        "return rate if moving is None else rate + moving",
        "return rate if moving is None else rate - moving",
    ),
    Fault("parts/tables.py", "return 0.5 * (self.values[..., 0] + self.values[..., -1])", "return self.values[..., 0]"),
    Fault(
        "parts/tables.py",
        "-local_spline.value(self.rates, self.forces, v[0])",
        "local_spline.value(self.rates, self.forces, v[0])",
    ),
    Fault("parts/tables.py", "forwards = jnp.where(control < 0, -speed, speed)", "forwards = speed"),
    # Parts: contacts, friction, tyres and ropes
    Fault("parts/contact.py", "* depth**2.5 / 2.5", "* depth**2.5 / 1.5"),
    Fault(
        "parts/contact.py",
        "return self.force(depth) * depth / (self.exponent + 1)",
        "return self.force(depth) * depth / self.exponent",
    ),
    Fault(
        "parts/contact.py",
        "self.cohesion * self.area * engaged + load * jnp.tan(self.friction_angle)",
        "self.cohesion * self.area + load * jnp.tan(self.friction_angle)",
    ),
    Fault(
        "parts/contact.py",
        "dry_friction(self.coefficient * load, slip",
        "dry_friction(self.coefficient * engaged, slip",
    ),
    Fault(
        "parts/contact.py",
        "space.point_force(pose, point, spring + damping * normal)",
        "space.point_force(pose, point, spring - damping * normal)",
    ),
    Fault("parts/contact.py", "return 0.5 * self.stiffness * depth**2", "return self.stiffness * depth**2"),
    Fault(
        "parts/contact.py",
        "lowest = space.body_point(pose, centre - radius * normal)",
        "lowest = space.body_point(pose, centre)",
    ),
    Fault("parts/dry_friction.py", "else slip - self.speed", "else slip + self.speed"),
    Fault("parts/dry_friction.py", "return reactions if self.in_gear", "return jnp.abs(reactions) if self.in_gear"),
    Fault(
        "parts/dry_friction.py",
        "self.contact_law, -slip_direction(self._modes(poses), slips)",
        "self.contact_law, slip_direction(self._modes(poses), slips)",
    ),
    Fault(
        "parts/contact_laws.py",
        "return law.slip if law.stick is None else jnp.maximum(law.slip, law.stick)",
        "return law.slip",
    ),
    Fault(
        "parts/dry_friction.py",
        'self.joints["0"].is_length(name) else self.radius * value',
        'self.joints["0"].is_length(name) else value / self.radius',
    ),
    Fault("parts/friction.py", "[sliding, self.radius * turning]", "[sliding, turning]"),
    Fault(
        "parts/friction.py",
        "sliding = sliding - space.point_velocity(poses[0], velocities[0], point_a)",
        "sliding = sliding + space.point_velocity(poses[0], velocities[0], point_a)",
    ),
    Fault("parts/magic_formula.py", "jnp.exp(c.PKX3 * dfz)", "jnp.exp(-c.PKX3 * dfz)"),
    Fault("parts/magic_formula.py", "return cosine(x + shift) / cosine(shift)", "return cosine(x + shift)"),
    Fault("parts/magic_formula.py", "return residual - trail * force", "return residual + trail * force"),
    Fault(
        "parts/magic_formula_tyre.py",
        "wheel.point.relaxation_lengths() * self.deflection",
        "wheel.point.relaxation_lengths()[::-1] * self.deflection",
    ),
    Fault("parts/magic_formula_tyre.py", "loaded = radius - depth / upright", "loaded = radius - depth"),
    Fault(
        "parts/modes.py",
        "jnp.where(jnp.dot(lax.stop_gradient(slip), modes) < 0, -1.0, 1.0)",
        "jnp.where(jnp.dot(lax.stop_gradient(slip), modes) > 0, -1.0, 1.0)",
    ),
    Fault("parts/rope.py", "turned = self._signed(k, xp.arctan2(sine", "turned = self._signed(k, -xp.arctan2(sine"),
    Fault("parts/contact_laws.py", "return 2.0 * jnp.tanh(0.5 * self.friction", "return 2.0 * jnp.tanh(self.friction"),
    Fault(
        "parts/rope.py",
        "unchecked_take(multipliers, self._span_of_side) + self._halves.T @ rise",
        "unchecked_take(multipliers, self._span_of_side) - self._halves.T @ rise",
    ),
    Fault("parts/rope.py", "jnp.where(stretch < 0, 0.0, pull)", "pull"),
    Fault(
        "parts/rope.py",
        "return self.length - self.lengths(space, poses)[0]",
        "return self.lengths(space, poses)[0] - self.length",
    ),
    Fault(
        "parts/rope.py",
        "off = of_parts(self._lifted(space, poses, along)) <= 0",
        "off = of_parts(self._lifted(space, poses, along)) <= -np.pi",
    ),
    Fault(
        "parts/tangents.py",
        "(length * flat - more * _left(axes, flat)) / square",
        "(length * flat + more * _left(axes, flat)) / square",
    ),
    Fault(
        "parts/tangents.py",
        "((_dots(along, moved) + more * turned)[:, 0], turned * left)",
        "(_dots(along, moved)[:, 0], turned * left)",
    ),
    Fault("parts/terrain.py", ".set(-slope)", ".set(slope)"),
    Fault(
        "parts/terrain.py",
        "/ jnp.sqrt(1 + jnp.dot(slope, slope))\n\n\ndef outward",
        "* jnp.sqrt(1 + jnp.dot(slope, slope))\n\n\ndef outward",
    ),
    Fault("parts/terrain.py", "self.peak * jnp.sin(jnp.pi * s) ** 2", "self.peak * jnp.sin(jnp.pi * s)"),
    Fault(
        "parts/terrain.py",
        "jnp.sin(2 * jnp.pi * place[0] / self.wavelength + self.phase)",
        "jnp.sin(2 * jnp.pi * place[0] / self.wavelength - self.phase)",
    ),
    Fault(
        "parts/terrain.py",
        "self.rise * step((place[0] - self.start) / self.length)",
        "self.rise * step(place[0] / self.length)",
    ),
    Fault("parts/terrain.py", "self.level + self.gradient * place[0]", "self.level - self.gradient * place[0]"),
    Fault("parts/tyre.py", "-slip - self._speed(rolling)", "-slip + self._speed(rolling)"),
    Fault("parts/tyre.py", "spring = load * square / (square + 0.25 * self.smoothing**2)", "spring = load"),
    Fault(
        "parts/tyre.py",
        "return jnp.stack([forwards, cross(normal_W, forwards)])",
        "return jnp.stack([forwards, cross(forwards, normal_W)])",
    ),
    Fault("parts/unilateral.py", "jnp.dot(d, d)) / (2 * self.length)", "jnp.dot(d, d)) / self.length"),
    Fault("parts/unilateral.py", "return self.near(value[None], middle)[0] - middle", "return value - middle"),
    Fault(
        "parts/unilateral.py",
        "return -jnp.sign(self._from_middle(value)) * rate",
        "return jnp.sign(self._from_middle(value)) * rate",
    ),
    Fault(
        "parts/unilateral.py",
        "return norm(place - self.point_a) - self.radius_a - self.radius_b",
        "return norm(place - self.point_a) - self.radius_a + self.radius_b",
    ),
    Fault(
        "parts/unilateral.py",
        "return jnp.dot(self.normal_a, place - self.point_a) - self.radius",
        "return jnp.dot(self.normal_a, place - self.point_a) + self.radius",
    ),
    Fault(
        "parts/unilateral.py",
        "clipped(centre, -0.5 * self.size, 0.5 * self.size)",
        "clipped(centre, -self.size, self.size)",
    ),
    Fault("parts/unilateral.py", "velocity(-1) - velocity(0) if len(poses) == 2", "velocity(-1) if len(poses) == 2"),
    Fault(
        "parts/unilateral.py",
        "return distance(self.terrain, place) - self.radius",
        "return distance(self.terrain, place) + self.radius",
    ),
    Fault(
        "parts/unilateral.py",
        "return (rate - normal * jnp.dot(normal, rate)) / size",
        "return rate / size",
    ),
    Fault("parts/unilateral.py", "jnp.where(out == 0, 0.0, velocity)", "velocity"),
    Fault(
        "parts/unilateral.py",
        "return axes - ((axes @ normal) / (1 + upwards @ normal))",
        "return axes - ((axes @ normal) / (2 + upwards @ normal))",
    ),
    Fault("parts/terrain.py", "(place, *(place - steps), *(place + steps))", "(place,)"),
    # Parts of the plane
    Fault("parts/planar/bodies.py", "return mass * radius**2 / 2", "return mass * radius**2 / 4"),
    Fault(
        "parts/planar/body_contact.py", "return self._fade(past) * self._fade(length - past)", "return self._fade(past)"
    ),
    Fault(
        "parts/planar/body_contact.py",
        "rub = self.friction.force(spring + damping, engaged",
        "rub = self.friction.force(spring, engaged",
    ),
    Fault(
        "parts/planar/body_contact.py", "return norm(place - centre) - radius", "return norm(place - centre) + radius"
    ),
    Fault(
        "parts/planar/draft_gear.py",
        "0.5 * (1 + self.unloading) + 0.5 * (1 - self.unloading)",
        "0.5 * (1 + self.unloading) - 0.5 * (1 - self.unloading)",
    ),
    Fault(
        "parts/planar/frames.py",
        "return self.position + rotate_2d(self.angle, point)",
        "return self.position + rotate_2d(-self.angle, point)",
    ),
    Fault(
        "parts/planar/joints.py",
        "[separation(space, self, poses), (relative_angle(poses) - self.angle)[None]]",
        "[separation(space, self, poses), relative_angle(poses)[None]]",
    ),
    Fault("parts/planar/joints.py", "stack([-axis[1], axis[0]])", "stack([axis[1], axis[0]])"),
    Fault(
        "parts/planar/joints.py",
        "return rotate_2d(-self.angle, self.axis_a)",
        "return rotate_2d(self.angle, self.axis_a)",
    ),
    Fault(
        "parts/planar/joints.py",
        "return space.body_point(poses[0], space.point(poses[1], self.point_b))",
        "return space.point(poses[1], self.point_b)",
    ),
    Fault(
        "parts/planar/joints.py",
        "(b - c - self.ratio * (a - c) - self.offset)",
        "(b - c - self.ratio * a - self.offset)",
    ),
    Fault(
        "parts/planar/joints.py",
        "+ self.radius * (poses[0, 2] - poses[1, 2])",
        "- self.radius * (poses[0, 2] - poses[1, 2])",
    ),
    Fault("parts/planar/joints.py", "return poses[1, 2] - poses[0, 2]", "return poses[0, 2] - poses[1, 2]"),
    Fault(
        "parts/planar/joints.py",
        "return jnp.dot(space.direction(poses[0], part.axis_a), separation(space, part, poses))",
        "return jnp.dot(part.axis_a, separation(space, part, poses))",
    ),
    Fault(
        "parts/planar/kinematics.py",
        "velocity[:2] + velocity[2:3] * _quarter_turn(_turned(pose, s))",
        "velocity[:2] + velocity[2:3] * _quarter_turn(s)",
    ),
    Fault(
        "parts/planar/kinematics.py",
        "(arm[0] * force_W[1] - arm[1] * force_W[0])",
        "(arm[1] * force_W[0] - arm[0] * force_W[1])",
    ),
    Fault(
        "parts/planar/torsion.py",
        "-spring.stiffness * (angle - spring.free_angle) - spring.damping * rate",
        "-spring.stiffness * (angle - spring.free_angle) + spring.damping * rate",
    ),
    Fault(
        "parts/planar/track.py",
        "straight[:, None] * d - more[:, None] * across",
        "straight[:, None] * d + more[:, None] * across",
    ),
    # Parts of space
    Fault(
        "parts/spatial/axes.py",
        "return 2.0 * rot.multiply(rot.conjugate(part.orientation), relative_orientation(poses))[1:]",
        "return rot.multiply(rot.conjugate(part.orientation), relative_orientation(poses))[1:]",
    ),
    Fault(
        "parts/spatial/axes.py",
        "turning = direction_in_a(space, poses, velocities[1, 3:]) - velocities[0, 3:]",
        "turning = direction_in_a(space, poses, velocities[1, 3:]) + velocities[0, 3:]",
    ),
    Fault(
        "parts/spatial/axes.py",
        "held = space.body_point(poses[0], space.point(poses[1], part.point_b))",
        "held = part.point_a",
    ),
    Fault("parts/spatial/axes.py", "np.append(size + start @ end, rot", "np.append(start @ end, rot"),
    Fault("parts/spatial/bodies.py", "(3 * radius**2 + length**2) / 12", "(radius**2 + length**2) / 12"),
    Fault("parts/spatial/bodies.py", "stack([y2 + z2, z2 + x2, x2 + y2])", "stack([y2 + z2, x2 + y2, z2 + x2])"),
    Fault("parts/spatial/bodies.py", "moment = 2 * as_parameter(mass)", "moment = as_parameter(mass)"),
    Fault("parts/spatial/composite.py", "start - self.points[k])", "start)"),
    Fault(
        "parts/spatial/composite.py",
        "jnp.where(jnp.sin(self.middle - flat) > 0, 1.0, -1.0)",
        "1.0 + 0.0 * jnp.where(jnp.sin(self.middle - flat) > 0, 1.0, -1.0)",
    ),
    Fault("parts/spatial/composite.py", "place = at - rot.rotate(turn, point)", "place = at"),
    Fault(
        "parts/spatial/frames.py",
        "turning = unrotate(self.orientation, velocity[3:])",
        "turning = rotate(self.orientation, velocity[3:])",
    ),
    Fault(
        "parts/spatial/joints.py",
        "[separation(space, self, poses), _parallel(space, self, poses)]",
        "[separation(space, self, poses), _parallel(space, self, poses[::-1])]",
    ),
    Fault("parts/spatial/joints.py", '"angle_b": -turn_about', '"angle_b": turn_about'),
    Fault(
        "parts/spatial/joints.py", '"angle_3": jnp.arctan2(-hand * c[0, 1]', '"angle_3": jnp.arctan2(-hand * c[1, 0]'
    ),
    Fault("parts/spatial/joints.py", "lead = self.pitch / (2 * np.pi)", "lead = self.pitch / np.pi"),
    Fault(
        "parts/spatial/joints.py",
        "displacement = jnp.stack([dot(self.x_a, shift), dot(y_a, shift)])",
        "displacement = jnp.stack([dot(y_a, shift), dot(self.x_a, shift)])",
    ),
    Fault(
        "parts/spatial/joints.py",
        "return jnp.concatenate([across(self.axis_a, offset_in_a(space, self, poses)), rotation_error(self, poses)])",
        "return jnp.concatenate([across(self.axis_a, separation(space, self, poses)), rotation_error(self, poses)])",
    ),
    Fault(
        "parts/spatial/joints.py",
        "height = dot(self.axis_a, offset_in_a(space, self, poses))",
        "height = dot(self.axis_a, separation(space, self, poses))",
    ),
    Fault(
        "parts/spatial/kinematics.py",
        "velocity[:3] + _turned(pose, rot.cross(velocity[3:], s))",
        "velocity[:3] + rot.cross(velocity[3:], _turned(pose, s))",
    ),
    Fault("parts/spatial/kinematics.py", "return _turned(pose, velocity[3:])", "return velocity[3:]"),
    Fault(
        "parts/spatial/point_joints.py",
        "return dot(self.axis_a, offset_in_a(space, self, poses))[None]",
        "return dot(self.axis_a, separation(space, self, poses))[None]",
    ),
    Fault(
        "parts/spatial/point_joints.py",
        "return across(self.axis_a, offset_in_a(space, self, poses))",
        "return across(self.axis_a, separation(space, self, poses))",
    ),
    Fault("parts/spatial/rolling.py", "slip = slip - self.spin", "slip = slip + self.spin"),
    Fault("parts/spatial/rolling.py", "self.radius * length / square", "self.radius * length**2 / square"),
    Fault(
        "parts/spatial/rolling.py",
        "return (height - self.radius * norm(self.normal))[None]",
        "return (height - 2 * self.radius * norm(self.normal))[None]",
    ),
    # Bodies and systems
    Fault("bodies/body_set.py", "mass[:, None] * gravity[None, :]", "mass[:, None] * -gravity[None, :]"),
    Fault(
        "bodies/body_set.py",
        "moment = -jax.vmap(lambda J, w: cross(w, J @ w))",
        "moment = jax.vmap(lambda J, w: cross(w, J @ w))",
    ),
    Fault("bodies/body_set.py", "moment = lambda J, w: -cross(w, J @ w)", "moment = lambda J, w: cross(w, J @ w)"),
    Fault("bodies/body_set.py", "jax.vmap(rotate)(poses[:, 3:], momenta[:, 3:])", "momenta[:, 3:]"),
    Fault(
        "bodies/elementary.py",
        "half = np.where(self.places.with_x, 1.0, 0.5)",
        "half = np.where(self.places.with_x, 1.0, 1.0)",
    ),
    Fault("bodies/elementary.py", "2.0 * self._dot(x_rate, rate.y)", "self._dot(x_rate, rate.y)"),
    Fault(
        "bodies/elementary.py",
        "arms = xp.stack([self._with_x(now.y) + now.y_a, -now.y_b])",
        "arms = xp.stack([self._with_x(now.y) - now.y_a, -now.y_b])",
    ),
    Fault(
        "bodies/groups.py",
        "return out + self.damping[:, None] * rate + self.stiffness[:, None] * value",
        "return out + self.damping[:, None] * rate",
    ),
    Fault(
        "bodies/groups.py",
        "jnp.where(driven.drives(member), value, given)",
        "jnp.where(driven.drives(member), given, value)",
    ),
    Fault(
        "bodies/groups.py",
        "return jax.jvp(residual, (t, x, v), (jnp.ones_like(t), xdot, a))[1]",
        "return jax.jvp(residual, (t, x, v), (jnp.zeros_like(t), xdot, a))[1]",
    ),
    Fault(
        "bodies/groups.py",
        "gap, rate = jax.jvp(gaps, (t, x), (jnp.ones_like(t), ",
        "gap, rate = jax.jvp(gaps, (t, x), (jnp.zeros_like(t), ",
    ),
    Fault("bodies/touch.py", "outward, c - radius * outward)", "outward, c + radius * outward)"),
    Fault(
        "bodies/touch.py",
        "[-space.force_at(x[0], at.centre, force), last]",
        "[space.force_at(x[0], at.centre, force), last]",
    ),
    Fault("bodies/touch.py", "carried + 2 * relative", "carried + relative"),
    Fault("bodies/touch.py", "bias = bias + jnp.dot(gradient, along)", "bias = bias - jnp.dot(gradient, along)"),
    Fault("bodies/touch.py", "velocity - radius * outward)", "velocity + radius * outward)"),
    Fault(
        "bodies/touch.py",
        "normal = gradient - at.normal * jnp.dot(at.normal, gradient)",
        "normal = gradient",
    ),
    Fault("bodies/touch.py", "bias + turn @ relative", "bias - turn @ relative"),
    Fault("bodies/touch.py", "turn = carried if turn is None else turn + carried", "turn = carried"),
    Fault(
        "bodies/touch.py",
        "slope = (axes @ rate - along * (upwards @ rate)) / size",
        "slope = (axes @ rate + along * (upwards @ rate)) / size",
    ),
    Fault(
        "bodies/law_groups.py",
        "return jax.jvp(gap, (t, x), (jnp.ones_like(t), xdot))[1]",
        "return jax.jvp(gap, (t, x), (jnp.zeros_like(t), xdot))[1]",
    ),
    Fault(
        "bodies/law_groups.py",
        "along = jnp.ones_like(t), jax.vmap(space.rates)(x, v)",
        "along = jnp.zeros_like(t), jax.vmap(space.rates)(x, v)",
    ),
    Fault(
        "bodies/law_groups.py",
        "return unchecked_take(norm(forces), np.array(members))",
        "return jnp.ones(len(members))",
    ),
    Fault(
        "bodies/motion.py",
        "felt = linear if gravity is None else linear - gravity",
        "felt = linear if gravity is None else linear + gravity",
    ),
    Fault(
        "bodies/motion.py",
        "specific = layout.space.body_direction(pose, felt)",
        "specific = layout.space.direction(pose, felt)",
    ),
    Fault(
        "bodies/reactions.py",
        "moment = moment - (arm[0] * force[1] - arm[1] * force[0])",
        "moment = moment + (arm[0] * force[1] - arm[1] * force[0])",
    ),
    Fault(
        "bodies/reactions.py",
        "moment = moment - cross(space.direction(pose, point), force)",
        "moment = moment - cross(point, force)",
    ),
    Fault(
        "bodies/rigid_bodies.py",
        "self.forces.gravity), start=energy)",
        "self.forces.gravity), start=-energy)",
    ),
    Fault(
        "bodies/body_set.py",
        "[-jnp.sum(self._of_rigid(self.mass) * heights)",
        "[jnp.sum(self._of_rigid(self.mass) * heights)",
    ),
    Fault(
        "bodies/rigid_bodies.py",
        "return 0.5 * jnp.dot(u, self.inertia(t, q, u).product(u))",
        "return jnp.dot(u, self.inertia(t, q, u).product(u))",
    ),
    Fault(
        "system/contact_set.py",
        "np.repeat([CLOSED, STICK], [self.n, self.m])",
        "np.repeat([CLOSED, CLOSED], [self.n, self.m])",
    ),
    Fault(
        "system/design_variables.py",
        "(value >= (low - slack(low)).astype(value.dtype)) &",
        "(value >= (low - slack(low)).astype(value.dtype)) |",
    ),
    Fault("system/instant.py", "rate / speed, 0.0)", "rate * speed, 0.0)"),
    Fault(
        "system/parameters.py",
        "value if index is None else replaced(old, index, value)",
        "value if index is None else replaced(old, 0, value)",
    ),
    Fault("system/parameters.py", "for group in reversed(system.design):", "for group in system.design:"),
    Fault("system/pulses.py", "step - jnp.abs(value - start) > most", "step + jnp.abs(value - start) > most"),
    # States
    Fault("states/arguments.py", "rates.get(name, jnp.zeros_like(value))", "jnp.zeros_like(value)"),
    Fault(
        "states/assembly.py",
        "assembled[index] - given[index]) > _CHANGED * size > 0",
        "assembled[index] - given[index]) > size > 0",
    ),
    Fault(
        "states/balance.py",
        "return self.applied(q) + self.of_rows(q, multipliers)",
        "return self.applied(q) - self.of_rows(q, multipliers)",
    ),
    Fault("states/consistency.py", "depths > tol", "depths < -tol"),
    Fault(
        "states/equilibrium.py", "stable = xp.min(values.real) >= -_FALLS", "stable = xp.max(values.real) >= -_FALLS"
    ),
    Fault("states/equilibrium.py", "xp.where(~quiet & (local.curvatures < 0), -size, size)", "size"),
    Fault(
        "states/gap.py",
        "jnp.where(open_, jnp.sqrt(jnp.where(open_, square, 1.0)), 0.0)",
        "jnp.where(open_, square, 0.0)",
    ),
    # Contacts: laws, events and their phases
    Fault(
        "contacts/dry_laws.py",
        "law = np.eye(n + m, dtype=b.dtype) + slope[:, None] * of_normal",
        "law = np.eye(n + m, dtype=b.dtype) - slope[:, None] * of_normal",
    ),
    Fault("contacts/dry_laws.py", "jnp.where(backward, -1.0, 1.0)", "jnp.where(backward, 1.0, -1.0)"),
    Fault(
        "contacts/events.py",
        '(True, False): "close", (False, True): "open"',
        '(True, False): "open", (False, True): "close"',
    ),
    Fault("contacts/events.py", "Event(time + float(rest), name", "Event(time - float(rest), name"),
    Fault(
        "contacts/forces.py",
        "coefficient, hold = sticking(at)",
        "coefficient, hold = slowly_sliding(at)",
    ),
    Fault(
        "contacts/friction.py",
        "across = jnp.stack([-e[:, 1], e[:, 0]], axis=1)",
        "across = jnp.stack([e[:, 1], e[:, 0]], axis=1)",
    ),
    Fault(
        "contacts/groups.py",
        "return jnp.where(holds, HOLDS, jnp.argmax(near, axis=1))",
        "return jnp.where(holds, HOLDS, 0 * jnp.argmax(near, axis=1))",
    ),
    Fault(
        "contacts/guards.py",
        "gaps * (1 - 0.5 * gaps / peaks)",
        "gaps * (1 - gaps / peaks)",
    ),
    Fault("contacts/guards.py", "modes.of_friction * rates[contacts.n :]", "rates[contacts.n :]"),
    Fault("contacts/impact.py", "dlate = dlate + _release(", "dlate = dlate - _release("),
    Fault("contacts/impact.py", "q + event.late * (before - after)", "q + event.late * (after - before)"),
    Fault(
        "contacts/impact.py",
        "event.late * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))\n    # Without",
        "0 * event.late * (system.state_rates(t, y.q, event.at) - system.state_rates(t, q, event.u))\n    # Without",
    ),
    Fault("contacts/impact.py", "dq + dlate * rates[0], du + dlate", "dq - dlate * rates[0], du + dlate"),
    Fault(
        "contacts/impacting.py",
        "jnp.maximum(-when.at[: self.contacts.n], 0.0)",
        "jnp.abs(when.at[: self.contacts.n])",
    ),
    Fault("contacts/impacting.py", "closing**2 - 2 * curve[:n] * gap", "closing**2 + 2 * curve[:n] * gap"),
    Fault(
        "parts/contact_laws.py",
        "return self.restitution * impulse",
        "return self.restitution**2 * impulse",
    ),
    Fault("contacts/impacting.py", "2 * rate / (falls * (1 - ratio))", "2 * rate / falls"),
    Fault(
        "contacts/impacting.py",
        "0.5 * (kinetic(when.u) - kinetic(after))",
        "(kinetic(when.u) - kinetic(after))",
    ),
    Fault(
        "contacts/phases.py",
        'frame.here.laws.ask("rebound", closing)',
        "closing",
    ),
    # Formulations
    Fault("formulations/friction.py", "return jnp.all((y > 0) & jnp.isfinite(y))", "return jnp.all(jnp.isfinite(y))"),
    Fault(
        "formulations/laws.py",
        "return at.force + at.friction_force(memory)",
        "return at.force - at.friction_force(memory)",
    ),
    Fault(
        "formulations/null_space.py",
        "Z.T @ (force - inertia.product(particular))",
        "Z.T @ (force + inertia.product(particular))",
    ),
    Fault(
        "formulations/partitioned.py",
        "return particular + product(factor.null_space, solve(load))",
        "return product(factor.null_space, solve(load))",
    ),
    Fault(
        "formulations/poincare.py",
        "multipliers = basis.inverse @ (bound - basis.range.T @ free)",
        "multipliers = basis.inverse @ (bound + basis.range.T @ free)",
    ),
    Fault("formulations/shares.py", "return multipliers - shares @ vanishing", "return multipliers"),
    Fault(
        "formulations/udwadia_kalaba.py",
        "jacobian.gather_rows(gamma) - A @ free",
        "jacobian.gather_rows(gamma) + A @ free",
    ),
    Fault(
        "formulations/udwadia_kalaba.py",
        "ahead = root.solve(force) - root.transpose().product(particular)",
        "ahead = root.solve(force) + root.transpose().product(particular)",
    ),
    Fault("formulations/udwadia_kalaba.py", "project = lambda x: x - rows.range", "project = lambda x: x + rows.range"),
    # Manifold
    Fault("manifold/baumgarte.py", "shift = shift + self.rate**2 *", "shift = shift + self.rate *"),
    Fault(
        "manifold/constraints.py", "laws.remembered(at, multipliers)) + at.constraint", "multipliers) + at.constraint"
    ),
    Fault("manifold/constraints.py", "return along.with_(u=along.u + here", "return along.with_(u=along.u - here"),
    Fault("manifold/constraints.py", "along = along.with_(u=along.u + here", "along = along.with_(u=along.u - here"),
    Fault(
        "manifold/implied.py",
        "bound = jnp.where(rows.independent > eps**_IMPLIED, displaced, allowed)",
        "bound = jnp.where(rows.independent > eps**_IMPLIED, allowed, displaced)",
    ),
    Fault(
        "manifold/implied.py",
        "rate = jnp.maximum(jnp.max(jnp.abs(udot) / scale), speed**2)",
        "rate = jnp.max(jnp.abs(udot) / scale)",
    ),
    Fault("manifold/impulse.py", "return t + (moved - fixed)", "return t"),
    Fault(
        "manifold/chart_constraints.py",
        "return -(self.factor.right_inverse @ residual)",
        "return self.factor.right_inverse @ residual",
    ),
    Fault("manifold/chart_constraints.py", "return change + answer @ responses, answer", "return change, answer"),
    Fault("manifold/chart.py", "at = at.with_(u=at.u - step)", "at = at.with_(u=at.u + step)"),
    Fault("linalg/arrays.py", "levels += 1", "levels = 1"),
    Fault("parts/bar_shapes.py", "max(2 * bending + 2, stretch + 1", "max(bending, stretch + 1"),
    Fault("parts/elastic.py", '"rab,plba->prl"', '"rab,plab->prl"'),
    Fault("parts/elastic.py", "-tables.shapes.shortening) / self.length", "tables.shapes.shortening) / self.length"),
    Fault("parts/elastic.py", "/ self.length - offset @ curvature", "/ self.length + offset @ curvature"),
    Fault("parts/elastic.py", "area * stretch / self.length", "area * stretch * self.length"),
    Fault("parts/spatial/elastic.py", "[0.0, -1.0], [1.0, 0.0]", "[0.0, 1.0], [1.0, 0.0]"),
    Fault("parts/spatial/elastic.py", "[self.thickness**2, self.width**2]", "[self.width**2, self.thickness**2]"),
    Fault("parts/planar/kinematics.py", "2 * xp.arctan(turn / 2)", "xp.arctan(turn / 2)"),
    Fault("parts/spatial/kinematics.py", "turn / 2]))", "turn]))"),
    Fault("parts/nodal.py", "np.linalg.solve(system, moved)", "np.linalg.solve(system, -moved)"),
    Fault("linalg/inertia.py", "self._apply(self.rest.solve(f), jax.vmap(solve_positive), f)", "self.rest.solve(f)"),
    Fault("bodies/groups.py", "momentum[:d]), -turning, along", "momentum[:d]), turning, along"),
    Fault("bodies/groups.py", "turning + cross(spin, momentum[3:6])", "turning - cross(spin, momentum[3:6])"),
    Fault("bodies/groups.py", "rates) - jax.grad(lambda", "rates) + jax.grad(lambda"),
    Fault("bodies/groups.py", "return energy - gravity @ (matrix", "return energy + gravity @ (matrix"),
    Fault("parts/frames.py", "wrench[d:] - space.force_at(pose", "wrench[d:] + space.force_at(pose"),
    Fault("parts/frames.py", "zeta, rates), *rest)[1](wrench)", "0.0 * zeta, rates), *rest)[1](wrench)"),
    Fault("states/equilibrium.py", "initial - inverse @ (unmet", "initial + inverse @ (unmet"),
    Fault("states/nearest.py", "return -(inverse[: x.size] @ change)", "return inverse[: x.size] @ change"),
    Fault("states/nearest.py", "curvature(forces), 0.0)", "0.0 * curvature(forces), 0.0)"),
    Fault(
        "manifold/projection.py",
        "at, udot, chart + iterations, failed | undetermined, near",
        "at, udot, chart, failed | undetermined, near",
    ),
    # Linear algebra
    Fault("linalg/bilinear.py", "sums[i] + product if value > 0 else sums[i] - product", "sums[i] + product"),
    Fault("linalg/block_elimination.py", "*(-right[i, :, k] * solved", "*(right[i, :, k] * solved"),
    Fault(
        "linalg/complementarity.py",
        "jnp.where(leaving < k, leaving + k, leaving - k)",
        "jnp.where(leaving < k, leaving, leaving - k)",
    ),
    Fault(
        "linalg/complementarity.py",
        "return W - columns.T @ solve(matrix, columns)",
        "return W + columns.T @ solve(matrix, columns)",
    ),
    Fault("linalg/elimination.py", "-(pushed @ factor.null_space)", "pushed @ factor.null_space"),
    Fault(
        "linalg/inertia.py",
        "matrix_products(inverses_3x3(self.inertia), n), 1 / self.mass, f)",
        "matrix_products(inverses_3x3(self.inertia), n), 1 / self.mass**2, f)",
    ),
    Fault(
        "linalg/jacobian.py", "towards - self.direction(self.multipliers(self.jacobian.product(towards)))", "towards"
    ),
    Fault("linalg/members.py", "*x.shape[2:])[:count], results)", "*x.shape[2:])[-count:], results)"),
    Fault("linalg/newton.py", "size * jnp.maximum(shrinks, rate)), k + 1", "size * rate), k + 1"),
    Fault("linalg/orthogonal.py", "-out.range @ turn.T", "out.range @ turn.T"),
    Fault("linalg/roots.py", "return y, -0.5 * y * y * y * tangents[0]", "return y, -0.5 * y * y * tangents[0]"),
    Fault("linalg/rotations.py", "return _square(p), _POLAR(2.0 * p, dp)", "return _square(p), _POLAR(p, dp)"),
    Fault(
        "linalg/rotations.py",
        "antisymmetric = xp.stack([difference[2, 1], difference[0, 2], difference[1, 0]])",
        "antisymmetric = xp.stack([difference[1, 2], difference[2, 0], difference[0, 1]])",
    ),
    Fault("linalg/rotations.py", "return 4.0 * pull_back(p, pdot)", "return 2.0 * pull_back(p, pdot)"),
    Fault("linalg/rotations.py", "total * near + term", "total * near"),
    Fault("linalg/rotations.py", "near, length = xp.where(p[0] < 0, -p, p)", "near, length = p"),
    # Batches in lanes
    Fault(
        "lanes/control.py",
        "return left & (jnp.arange(lanes.size) != k), out",
        "return left & (jnp.arange(lanes.size) > lanes.size), out",
    ),
    Fault(
        "lanes/elementary.py",
        "jnp.where(turn >= 2, -sine, sine), jnp.where((turn == 1) | (turn == 2), -cosine, cosine)",
        "jnp.where(turn >= 2, -sine, sine), jnp.where(turn >= 2, -cosine, cosine)",
    ),
    Fault("lanes/elementary.py", "large = mantissa > math.sqrt(2)", "large = mantissa > 2"),
    Fault("lanes/indexing.py", "for first in range(1, n - k + 1):", "for first in range(1, n - k):"),
    Fault("lanes/shapes.py", "strides = None if strides is None else (*strides, 1)", "strides = None"),
    # Solvers
    Fault("solvers/_dense.py", "return out, -out @ tangents[0] @ out", "return out, -out @ tangents[0]"),
    Fault("solvers/_dense.py", "- self.acceleration @ change\n", "+ self.acceleration @ change\n"),
    Fault("solvers/_formulas.py", "slope = means / values - curvature", "slope = means / values + curvature"),
    Fault(
        "solvers/_newton.py", "filled(step.a, along.a) * f + filled(step.b, along.b) * g", "filled(step.a, along.a) * f"
    ),
    Fault(
        "solvers/_stiffness.py",
        "jnp.where(stiff > 0, before.level + _UP, before.level - _DOWN)",
        "jnp.where(stiff > 0, before.level + _DOWN, before.level - _UP)",
    ),
    Fault(
        "solvers/adams.py", "+ of.h * of.last * (second.f - neighbours[1])", "+ of.last * (second.f - neighbours[1])"
    ),
    Fault("solvers/adams.py", "jnp.maximum(sizes, _TARGET * reached**2)", "sizes"),
    Fault("solvers/adams_steps.py", "return last - change,", "return last + change,"),
    Fault(
        "solvers/adams_steps.py",
        "corrected = predicted + h * formulas.last * (f - neighbours[1])",
        "corrected = predicted + h * formulas.last * f",
    ),
    Fault("solvers/controller.py", "** response\n", "** (1 / response)\n"),
    Fault("solvers/events.py", "cubic = 4 * (0.125 * at_start", "cubic = 4 * (0.25 * at_start"),
    Fault(
        "solvers/events.py",
        "falling = jnp.any((jnp.abs(last.end) <= guards.touch) & (last.rates < 0))",
        "falling = jnp.any((jnp.abs(last.end) <= guards.touch) & (last.rates > 0))",
    ),
    Fault(
        "solvers/events.py",
        "turns = jnp.where(rates > 0, start < 0, ends > 0)",
        "turns = jnp.where(rates > 0, start < 0, ends < 0)",
    ),
    Fault(
        "solvers/events.py",
        "accepted=yes, next_t1=next_t1, starts=starts, start=start, ended=no",
        "accepted=yes, next_t1=next_t1, starts=starts, start=start, ended=yes",
    ),
    Fault("solvers/events.py", "jnp.where(jumps, after, t1)", "t1"),
    Fault("simulate/stops.py", "return times + jnp.sum(moves, axis=1)", "return times - jnp.sum(moves, axis=1)"),
    Fault("solvers/hermite.py", "used.size), dtype) @ (1 / (formula.end", "used.size), dtype) @ (2 / (formula.end"),
    Fault("solvers/mesh.py", "lw = lw + table[0]", "lw = lw"),
    Fault("solvers/mesh.py", "jnp.where(is_last, c, 0)", "jnp.where(is_last, 0, c)"),
    Fault("solvers/multistep.py", "off = jnp.isnan(estimate.lowest)", "off = jnp.array(False)"),
    Fault("solvers/stability.py", "polynomial = a - mu * b - mu**2 * c", "polynomial = a - mu * b + mu**2 * c"),
    # Motions
    Fault(
        "simulate/outcome.py",
        'leaves = "leaves its reach" if len(lost.drives) == 1 else "leave their reach"',
        'leaves = "leave their reach" if len(lost.drives) == 1 else "leaves its reach"',
    ),
    Fault("simulate/span.py", "lax.stop_gradient(t) - t), primals", "t - lax.stop_gradient(t)), primals"),
    Fault("simulate/span.py", "/ 2 * g), y, first, second)", "* g), y, first, second)"),
    Fault(
        "simulate/stops.py",
        "jnp.sort(jnp.concatenate([jnp.asarray(times), jnp.asarray(of_inputs, times.dtype)]))",
        "jnp.sort(jnp.asarray(times))",
    ),
    Fault("simulate/watch.py", "{name: at + step * x for", "{name: at - step * x for"),
    Fault(
        "trajectory.py",
        "return self.kinetic_energy + self.potential_energy",
        "return self.kinetic_energy - self.potential_energy",
    ),
    Fault(
        "trajectory.py",
        "position.at[:rows].divide(sizes[:rows]), velocity / sizes",
        "position.at[:rows].multiply(sizes[:rows]), velocity / sizes",
    ),
    Fault("trajectory.py", "jnp.max(jnp.abs(x) / scale[None], initial=0.0)", "jnp.max(jnp.abs(x), initial=0.0)"),
    # Studies: small motions
    Fault(
        "studies/linear/comoving.py",
        "0.5 * multiply(whole, p) + rotations.rates(p, s)",
        "0.5 * multiply(p, whole) + rotations.rates(p, s)",
    ),
    Fault(
        "studies/linear/comoving.py",
        "self.travel[:, :d] + turned(state.q[position])",
        "self.travel[:, :d] - turned(state.q[position])",
    ),
    Fault("studies/linear/eigen.py", ".set(-vector).at[n, :n]", ".set(vector).at[n, :n]"),
    Fault("studies/linear/floquet.py", "return jnp.log(values) / self.period", "return jnp.log(values) * self.period"),
    Fault("studies/linear/floquet.py", "return distance, sign[:, None] * pushed", "return distance, pushed"),
    Fault(
        "studies/linear/linear_equations.py",
        "directions.reading @ (here.by_states - moves.rate[best] @ directions.basis)",
        "directions.reading @ here.by_states",
    ),
    Fault(
        "studies/linear/linearisation.py",
        "jnp.where(size > 0, -values.real / jnp",
        "jnp.where(size > 0, values.real / jnp",
    ),
    Fault(
        "studies/linear/linearisation.py",
        "C @ jnp.linalg.solve(shift(w) - A, B) + D",
        "C @ jnp.linalg.solve(shift(w) - A, B)",
    ),
    Fault(
        "studies/linear/linearisation.py",
        "jnp.cos(phase) * shape.real - jnp.sin(phase)",
        "jnp.cos(phase) * shape.real - jnp.cos(phase)",
    ),
    Fault("studies/linear/root_locus.py", "self.values[k] - growth[k]", "self.values[k] + growth[k]"),
    Fault("studies/linear/steady.py", "spins - unknowns.turning[2]", "spins + unknowns.turning[2]"),
    # Studies: inverse dynamics, loads, suspensions
    Fault("studies/inverse/balance.py", "unbalanced = inertia - force", "unbalanced = inertia + force"),
    Fault("studies/inverse/drives.py", "return jax.jacfwd(rate)(at.u)", "return -jax.jacfwd(rate)(at.u)"),
    Fault("studies/inverse/required.py", "1 / jnp.sqrt(value)", "1 / value"),
    Fault(
        "studies/loads.py",
        "return points + centre[None], forces, moments - jnp.cross(points, forces)",
        "return points + centre[None], forces, moments",
    ),
    Fault("studies/loads.py", "on_body(without - system.inertia(now.t", "on_body(without + system.inertia(now.t"),
    Fault(
        "studies/loads.py",
        "arms = self.points - self.mass_centre[None, None]",
        "arms = self.points + self.mass_centre[None, None]",
    ),
    Fault("studies/loads.py", 'kind not in ("gravity", "inertia")', 'kind not in ("gravity",)'),
    Fault(
        "studies/loads.py",
        "point is None and isinstance(part, AbstractCoordinatePart)",
        "point is not None and isinstance(part, AbstractCoordinatePart)",
    ),
    Fault("studies/suspension/kinematics.py", "{name: -rates.lengths[..., k, 0]", "{name: rates.lengths[..., k, 0]"),
    Fault(
        "studies/suspension/kinematics.py",
        "curves.patch[..., 1] * rates.patch[..., 1, 0] / rates.patch[..., 2, 0]",
        "curves.patch[..., 1] * rates.patch[..., 2, 0] / rates.patch[..., 1, 0]",
    ),
    Fault("studies/suspension/wheel.py", "jnp.arctan2(axle[0], self.side * axle[1])", "jnp.arctan2(axle[0], axle[1])"),
    Fault(
        "studies/suspension/wheel.py",
        "jnp.arctan2(-self.side * upward[1], upward[2])",
        "jnp.arctan2(self.side * upward[1], upward[2])",
    ),
    # Studies: fits, optimisation, sweeps
    Fault("studies/batch.py", "        if number != count:", "        if number < count:"),
    Fault("studies/identify/covariance.py", "surplus = count - int(", "surplus = count + int("),
    Fault("studies/identify/density.py", "problem.free.log_volume(z) - problem.objective(z)", "-problem.objective(z)"),
    Fault(
        "studies/identify/loss.py",
        "return residuals * slope, slope + 2 * squares",
        "return residuals * slope, slope - 2 * squares",
    ),
    Fault("studies/identify/profile.py", "float(ndtri((1 + level) / 2)) ** 2", "float(ndtri(level)) ** 2"),
    Fault("studies/identify/residuals.py", "np.median(sizes) / 0.6745", "np.median(sizes)"),
    Fault("studies/identify/segments.py", "(arrival - starts[0], places", "(starts[0] - arrival, places"),
    Fault("studies/identify/sensors.py", "return gain * quantity + bias", "return gain * (quantity + bias)"),
    Fault("studies/identify/sensors.py", "+ jnp.sum(count * log)", "+ jnp.sum(log)"),
    Fault(
        "studies/minimise.py",
        "target = np.append(-model.residuals, np.zeros_like(weights)) - whole @ closed",
        "target = np.append(-model.residuals, np.zeros_like(weights))",
    ),
    Fault(
        "studies/evaluate.py",
        '(("q", system.coordinate_names()), ("u", ',
        '(("u", system.coordinate_names()), ("q", ',
    ),
    Fault("studies/plan/courses.py", "3 * (b - a) - 2 * rate_a - rate_b", "3 * (b - a) - 2 * rate_a + rate_b"),
    Fault("studies/plan/courses.py", "numbers[1] - numbers[0]", "numbers[1]"),
    Fault("studies/plan/lanes.py", "_ASIDE * np.where(scales > 0, scales, 1.0)", "np.where(scales > 0, scales, 1.0)"),
    Fault("studies/plan/result.py", "-answer.multipliers[rows]", "answer.multipliers[rows]"),
    Fault("studies/plan/result.py", "-answer.of_bounds[", "answer.of_bounds["),
    Fault("studies/plan/sensitivity.py", "-linalg.splu(matrix)", "linalg.splu(matrix)"),
    Fault("studies/plan/solve.py", "switches.add(1 + max(", "switches.add(max("),
    Fault("studies/plan/task.py", "jnp.sum(jnp.square(at[name]))", "jnp.sum(jnp.abs(at[name]))"),
    Fault("studies/optimise/constrained.py", "-trials.scales[1, upper]", "trials.scales[1, upper]"),
    Fault("studies/optimise/robust.py", "out[name] = mean + weight * spread", "out[name] = mean - weight * spread"),
    Fault("studies/optimise/robust.py", "jnp.var(values, axis=0, ddof=1)", "jnp.var(values, axis=0)"),
    Fault(
        "studies/optimise/starts.py",
        "np.where(here.rows < limits.low, -1 / scales[0], 1 / scales[1])",
        "np.where(here.rows < limits.low, 1 / scales[0], 1 / scales[1])",
    ),
    Fault(
        "studies/optimise/trials.py",
        "return (violation if violation > HOLDS else 0.0), float(trial.rows[0])",
        "return 0.0, float(trial.rows[0])",
    ),
    Fault("studies/ranges.py", "jnp.exp(diagonal) - diagonal", "jnp.exp(2 * diagonal) - diagonal"),
    Fault(
        "studies/ranges.py", "jax.nn.sigmoid(self._logit(self.start) + z", "jax.nn.sigmoid(self._logit(self.start) - z"
    ),
    Fault("studies/sweep/cases.py", "columns[name] = np.exp(value) if name in log else value", "columns[name] = value"),
    Fault(
        "studies/sweep/cases.py",
        "places = np.indices(sizes).reshape(len(sizes), -1)",
        "places = np.indices(sizes[::-1]).reshape(len(sizes), -1)[::-1]",
    ),
    Fault(
        "studies/sweep/chunk.py",
        "np.minimum(np.arange(start, start + self._size), count - 1)",
        "np.minimum(np.arange(self._size), count - 1)",
    ),
    Fault(
        "studies/sweep/outputs.py",
        "if found.result is None else ~np.isnan(value)",
        "if found.result is None else np.isfinite(value)",
    ),
    # Importers
    Fault(
        "importers/build.py",
        '{"stiffness": inertia / time**2, "damping": 2 * inertia / time}',
        '{"stiffness": inertia / time, "damping": 2 * inertia / time}',
    ),
    Fault(
        "importers/build.py",
        "attitude = from_matrix(turn_a @ loop.rotation @ turn_b.T)",
        "attitude = from_matrix(turn_a @ loop.rotation.T @ turn_b.T)",
    ),
    Fault(
        "importers/build.py",
        "force = -share * link.mass * self.machine.gravity",
        "force = share * link.mass * self.machine.gravity",
    ),
    Fault(
        "importers/chains.py",
        "np.cos(joint.reference) * x + np.sin(joint.reference)",
        "np.cos(joint.reference) * x - np.sin(joint.reference)",
    ),
    Fault(
        "importers/chains.py",
        "a.point(joint.point - joint.reference * joint.axis)",
        "a.point(joint.point + joint.reference * joint.axis)",
    ),
    Fault(
        "importers/chains.py", "turn @ (point - rotation @ point) + shift", "turn @ (rotation @ point - point) + shift"
    ),
    Fault(
        "importers/description.py",
        "turn_about(z, yaw) @ turn_about(y, pitch) @ turn_about(x, roll)",
        "turn_about(x, roll) @ turn_about(y, pitch) @ turn_about(z, yaw)",
    ),
    Fault(
        "importers/export.py",
        "inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]",
        "inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 2, 1, 2]]",
    ),
    Fault(
        "importers/export_forces.py",
        "free = (before * its_free + stiffness * free) / total",
        "free = (its_free + free) / 2",
    ),
    Fault(
        "importers/export_tree.py", "powers[0] += float(coupling.zero) - x.value", "powers[0] += float(coupling.zero)"
    ),
    Fault(
        "importers/fuse.py",
        "(arm @ arm * np.eye(3) - np.outer(arm, arm))",
        "(arm @ arm * np.eye(3) + np.outer(arm, arm))",
    ),
    Fault("importers/fuse.py", "axis @ link.inertia @ axis + link.mass * arm @ arm", "axis @ link.inertia @ axis"),
    Fault(
        "importers/light.py",
        "axes @ np.diag([*moments[:2], most]) @ axes.T",
        "axes.T @ np.diag([*moments[:2], most]) @ axes",
    ),
    Fault(
        "importers/mjcf.py",
        "stop = (1 / model.dof_invweight0[dof], time * ratio)",
        "stop = (1 / model.dof_invweight0[dof], time)",
    ),
    Fault(
        "importers/mjcf.py", "velocity[3:] + np.cross(velocity[:3], arm)", "velocity[3:] - np.cross(velocity[:3], arm)"
    ),
    Fault("importers/mjcf.py", "data[0] / scale, others", "data[0], others"),
    Fault("importers/mjcf_actuators.py", "/ gear)\n", "* gear)\n"),
    Fault("importers/sdf.py", "version < (1, 5) if in_model", "version > (1, 5) if in_model"),
    Fault(
        "importers/sdf.py",
        "place[0] + place[1] @ position, place[1] @ rotation",
        "place[0] + position, place[1] @ rotation",
    ),
    Fault("importers/urdf.py", "parent.position + parent.rotation @ position", "parent.position + position"),
    Fault("importers/urdf.py", "[(other, np.array([factor]), 0.0)]", "[(other, np.array([1 / factor]), 0.0)]"),
    # Lagrange's equations
    Fault(
        "lagrangian/constraints.py",
        "return second + self.damping * rate + self.stiffness * phi(t, q)",
        "return second + self.damping * rate - self.stiffness * phi(t, q)",
    ),
    Fault(
        "lagrangian/hamel.py",
        "right = momenta @ transitivity - system.momentum",
        "right = momenta @ transitivity + system.momentum",
    ),
    Fault(
        "lagrangian/nonideal.py",
        "return -parameters[self.coefficient] * pull(s)[0]",
        "return parameters[self.coefficient] * pull(s)[0]",
    ),
    Fault(
        "lagrangian/quasi.py",
        "change = -drift if dtarget is None else dtarget - drift",
        "change = drift if dtarget is None else dtarget + drift",
    ),
    Fault(
        "lagrangian/voronets.py",
        "right = momentum @ (W - curvature) - momentum @ W",
        "right = momentum @ (W + curvature) - momentum @ W",
    ),
    # Reports, pictures, commands, mechanisms
    Fault("cli/doctor.py", "text if all(versions.values())", "text if any(versions.values())"),
    Fault("cli/run.py", "np.linalg.norm(np.stack(others) - first, axis=1)", "np.linalg.norm(np.stack(others), axis=1)"),
    Fault(
        "mechanisms/_relative.py",
        "return jnp.concatenate([behind[:1], -behind[1:]])",
        "return jnp.concatenate([behind[:1], behind[1:]])",
    ),
    Fault("mechanisms/flyball.py", '"alpha": jnp.arctan2(-along[:, 2]', '"alpha": jnp.arctan2(along[:, 2]'),
    Fault("mechanisms/four_bar.py", "(coupler**2 - rocker**2 + distance**2)", "(rocker**2 - coupler**2 + distance**2)"),
    Fault(
        "mechanisms/mechanism.py", "np.where(largest > 1e-12, largest, 1.0)", "np.where(largest < 1e-12, largest, 1.0)"
    ),
    Fault("report/evaluations.py", "(tableau.num_stages - tableau.fsal) + int(tableau.fsal)", "tableau.num_stages"),
    Fault("report/stress_test.py", '"small" if error < known_to else error', '"small" if error > known_to else error'),
    Fault("report/table.py", "cell.ljust(widths[k]) if k < words", "cell.ljust(widths[k]) if k <= words"),
    Fault("report/variants.py", "float(factor) ** np.squeeze(exponents)", "float(factor) ** -np.squeeze(exponents)"),
    Fault("report/work_precision.py", "float(error[-1]) for error", "float(error[0]) for error"),
    Fault(
        "viz/animation.py",
        "played.append(((single.times - first) / speed, nodes))",
        "played.append(((single.times - first) * speed, nodes))",
    ),
    Fault("viz/meshes.py", "angle = 2 * np.pi * _COIL_TURNS * wound", "angle = np.pi * _COIL_TURNS * wound"),
    Fault("viz/motion.py", "if np.ptp(line.values) <= _STILL * size", "if np.ptp(line.values) >= _STILL * size"),
    Fault("parts/planar/joints.py", "distance / (1 - self.ratio)", "distance / (1 + self.ratio)"),
    Fault("parts/planar/level_curves.py", "point + step * along", "point - 2 * step * along"),
    Fault("bodies/picture.py", "+ np.maximum(slack, 0.0)", "+ 2 * np.maximum(slack, 0.0)"),
    Fault("viz/placed_names.py", "for distance in _DISTANCES", "for distance in _DISTANCES[:1]"),
    Fault("viz/scenery.py", "np.maximum(beside, above)", "np.minimum(beside, above)"),
    Fault(
        "viz/silhouettes.py",
        "(points * shape.scale) @ rotation_matrix(shape.orientation).T",
        "(points * shape.scale) @ rotation_matrix(shape.orientation)",
    ),
    Fault(
        "viz/solids.py", "6.0 * (np.sum(values) - 2.0 * values) / mass", "12.0 * (np.sum(values) - 2.0 * values) / mass"
    ),
]
