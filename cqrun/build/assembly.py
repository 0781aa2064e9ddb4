"""Map values by key path to the engine's inputs, and the cotangent of the inputs back to gradients by path.

A value is one number (`per: body`), one number per group, or one per particle. A path without a value keeps the value
in the scene. `inputs` is the map and `gradient` its adjoint; each part of the map is next to its adjoint.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np

from cqrun.build.actuation import Actuation
from cqrun.build.initial_motion import InitialMotion
from cqrun.build.particles import Particles, stress_key
from cqrun.build.regions import boundary
from cqrun.build.rest_shape import Geometry
from cqrun.build.rigid_values import RigidValues
from cqrun.build.values import Values, collect, updated
from cqrun.engine.model import Inputs
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.loads.gravity import Gravity
from cqrun.loads.load import Load
from cqrun.objectives.design import DESIGN, MASS, RATIO, STIFFNESS, VOLUME
from cqrun.observers.track import TrackBar
from cqrun.plugin.contract import Array, Plugin, is_differentiable
from cqrun.scene.schema import Scene
from cqrun.scene.world_and_time import BodyContact
from cqrun.state import ParticleFields, State


class Assembly:
    """The map from values to inputs for one scene.

    Args:
        scene: the resolved scene.
        particles: the particles of the scene.
        sequence: number of the random activation sequence that drives the actuators.
    """

    def __init__(self, scene: Scene, particles: Particles, sequence: int = 0) -> None:
        self.scene, self.particles, self.sequence = scene, particles, sequence
        self.actuation, self.geometry = Actuation(scene, particles), Geometry(scene, particles)
        self.initial_motion, self.rigid = InitialMotion(scene, particles), RigidValues(scene, particles)
        self.loads: list[tuple[str, Load]] = [
            (f"loads.{name}.{chosen.name}", chosen.value)  # type: ignore[misc]
            for name, chosen in scene.loads.items()
        ]
        self.loads.append(("world", Gravity(gravity=list(scene.world.gravity))))
        self.loads.sort(key=lambda item: item[1].order)
        self.load_particles = [particles.inside(load.body, load.region) for _, load in self.loads]

    def with_sequence(self, sequence: int) -> Assembly:
        """Return the same map with another random activation sequence."""
        return Assembly(self.scene, self.particles, sequence)

    def reaches(self, path: str) -> bool:
        """Return whether the engine's inputs depend on a path; they do not depend on the start of a recording."""
        return not path.startswith("data.")

    def velocities(self, body: str, values: Values) -> Array:
        """Return a body's velocities at the start (N_b, D) [m/s]."""
        return self.initial_motion.of_body(body, self.geometry.at_rest(values)[0], values)[0]

    # --- values -------------------------------------------------------------------------------------------

    def _region_values(self, body: str, path: str) -> list[tuple[Array, str, float]]:
        """Return the values that `material_of` sets in place of a path's: (which particles (N_b,), path, value)."""
        base = f"bodies.{body}.material"
        suffix, regions = path.removeprefix(f"{base}."), []
        for name, other in self.scene.bodies[body].material_of.items():
            value = other.value(suffix)
            if value is not None:
                regions.append((self.particles.points[body].named(name), f"{base}_of.{name}.{suffix}", value))
        return regions

    def _per_particle(self, body: str, path: str, default: float, values: Values) -> Array:
        """Return the value of a path for each of a body's particles (N_b,)."""
        result = self._body_value(body, path, default, values)
        for inside, region_path, value in self._region_values(body, path):
            result[inside] = float(np.asarray(values.get(region_path, value)).reshape(-1)[0])
        return result

    def _body_value(self, body: str, path: str, default: float, values: Values) -> Array:
        """Return the same (N_b,) without the values that `material_of` sets."""
        n = self.particles.of(body)
        count = n.stop - n.start
        value = np.asarray(values.get(path, default), float)
        if value.ndim == 0:
            return np.full(count, float(value))
        if value.size == count:
            return value.reshape(-1).copy()
        labels = self.particles.labels(body)
        return np.where(labels >= 0, value.reshape(-1)[labels], default)

    def _per_particle_vjp(
        self, body: str, path: str, per_particle_bar: Array, values: Values, out: dict[str, Array]
    ) -> None:
        """Add the cotangent of the result of `_per_particle` to `out`, for those of its paths that have a value."""
        remaining = per_particle_bar.copy()
        for inside, region_path, _ in reversed(self._region_values(body, path)):
            if region_path in values:
                bar = out.setdefault(region_path, np.zeros(np.shape(values[region_path])))
                bar += remaining[inside].sum()
            remaining[inside] = 0.0
        self._body_value_vjp(body, path, remaining, values, out)

    def _body_value_vjp(
        self, body: str, path: str, per_particle_bar: Array, values: Values, out: dict[str, Array]
    ) -> None:
        """Add the cotangent of the result of `_body_value` to out[path], if the path has a value."""
        if path not in values:
            return
        value = np.asarray(values[path], float)
        bar = out.setdefault(path, np.zeros(value.shape))
        if value.ndim == 0:
            bar += per_particle_bar.sum()
        elif value.size == len(per_particle_bar):
            bar += per_particle_bar.reshape(value.shape)
        else:
            labels = self.particles.labels(body)
            np.add.at(bar.reshape(-1), labels[labels >= 0], per_particle_bar[labels >= 0])

    # --- inputs and gradient --------------------------------------------------------------------------------

    def inputs(self, values: Values) -> Inputs:
        """Return the engine's inputs."""
        x, volume = self.geometry.at_rest(values)
        state = State.at_rest(x, self.particles.layout.history)
        state.v[:], state.C[:] = self.initial_motion.at_start(x, values)
        fields, _ = self._fields(volume, values)
        drive = self.actuation
        return Inputs(
            state, fields, self._terms(values), drive.activations(self.sequence, values), drive.strengths(values),
            self._coefficients(values), drive.weights(values), drive.rest_lengths(x), self._moves(values),
            self.geometry.surface_at_rest(values), drive.frictions(values), *self.rigid.inputs(values),
            shaped=self.geometry.changes(values),
        )  # fmt: skip

    def gradient(self, values: Values, bar: Inputs) -> dict[str, Array]:
        """Return the gradient by path, each with the shape of its value, from the cotangent of the inputs."""
        out = {path: np.zeros(np.shape(value)) for path, value in values.items()}
        x, volume = self.geometry.at_rest(values)
        moving_bar = self.initial_motion.at_start_vjp(x, values, bar.state.v, bar.state.C, out)
        x_bar = bar.state.x + moving_bar + self.actuation.rest_lengths_vjp(x, bar.rest)
        self.geometry.at_rest_vjp(values, x_bar, self._fields_vjp(volume, values, bar, out), out)
        self._terms_vjp(values, bar, out)
        self.actuation.activations_vjp(bar.activation, self.sequence, values, out)
        self.actuation.strengths_vjp(bar.strength, out)
        self.actuation.frictions_vjp(bar.friction, out)
        self.actuation.weights_vjp(bar.weights, out)
        self._coefficients_vjp(values, bar, out)
        self._moves_vjp(bar, out)
        self.geometry.surface_at_rest_vjp(values, bar.surface, out)
        self.rigid.inputs_vjp(values, bar.rigid, bar.waypoints, out)
        return out

    # --- masses and loads -------------------------------------------------------------------------------------

    def _fields(self, volume: Array, values: Values) -> tuple[ParticleFields, list[Load]]:
        fields = ParticleFields.zeros(len(volume), self.scene.dim)
        fields.volume[:] = volume
        for body in self.particles.names:
            part = self.particles.of(body)
            path, default = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
            fields.mass[part] = self._per_particle(body, path, default, values) * fields.volume[part]
        loads = [updated(load, path, values) for path, load in self.loads]
        for load, indices in zip(loads, self.load_particles, strict=True):
            load.apply(fields, indices)
        return fields, loads

    def _fields_vjp(self, volume: Array, values: Values, bar: Inputs, out: dict[str, Array]) -> Array:
        """Add to the gradients in `out`, and return the cotangent of the volumes (N,)."""
        fields, loads = self._fields(volume, values)
        fields_bar = copy.deepcopy(bar.fields)  # loads change it, but the given cotangent must not change
        steps = list(zip(self.loads, loads, self.load_particles, strict=True))
        for (path, _), load, indices in reversed(steps):
            cotangents = load.apply_vjp(fields, fields_bar, indices)
            require_complete(load, path, cotangents, out)
            collect(path, cotangents, out)
        for body in self.particles.names:
            part = self.particles.of(body)
            path, default = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
            self._per_particle_vjp(body, path, fields_bar.mass[part] * volume[part], values, out)
            fields_bar.volume[part] += fields_bar.mass[part] * self._per_particle(body, path, default, values)
        return fields_bar.volume

    # --- material terms -------------------------------------------------------------------------------------------

    def _terms_of(self, body: str) -> list[tuple[str, Any, str]]:
        """Return (path, spec, path of the elastic term) for each term of a body's stress."""
        material, base = self.scene.bodies[body].material, f"bodies.{body}.material"
        elastic = f"{base}.elastic.{material.elastic.name}"
        further = [(f"{base}.{name}", spec, elastic) for name, spec in material.terms.items()]
        return [(elastic, material.elastic.value, elastic), *further]

    def _rows(self, body: str, path: str, spec: Any, elastic: str) -> list[tuple[str, float]]:
        """Return path and scene value of each row of theta; a term may use parameters of the elastic term."""
        law = self.scene.bodies[body].material.elastic.value
        return [
            (f"{path}.{name}", getattr(spec, name))
            if name in type(spec).model_fields
            else (f"{elastic}.{name}", getattr(law, name))
            for name in spec.parameters
        ]

    def material(self, body: str, values: Values) -> dict[str, Array]:
        """Return every number of a body's material for each of its particles (N_b,), by its path."""
        rows = [(f"bodies.{body}.material.density", self.scene.bodies[body].material.density)]
        rows += [row for term in self._terms_of(body) for row in self._rows(body, *term)]
        return {path: self._per_particle(body, path, default, values) for path, default in rows}

    def _theta(self, body: str, term: tuple[str, Any, str], values: Values) -> Array:
        return np.array([self._per_particle(body, path, default, values) for path, default in self._rows(body, *term)])

    def _groups(self) -> list[list[str]]:
        groups: dict[Any, list[str]] = {}
        for body in self.particles.names:
            groups.setdefault(stress_key(self.scene, body), []).append(body)
        return list(groups.values())

    def _terms(self, values: Values) -> list[list[Array]]:
        groups = []
        for bodies in self._groups():
            thetas = [[self._theta(body, term, values) for term in self._terms_of(body)] for body in bodies]
            groups.append([np.concatenate(parts, axis=1) for parts in zip(*thetas, strict=True)])
        return groups

    def _terms_vjp(self, values: Values, bar: Inputs, out: dict[str, Array]) -> None:
        for g, bodies in enumerate(self._groups()):
            begin = self.particles.of(bodies[0]).start
            for body in bodies:
                part = self.particles.of(body)
                for k, term in enumerate(self._terms_of(body)):
                    theta_bar = bar.terms[g][k][:, part.start - begin : part.stop - begin]
                    for row, (path, _) in zip(theta_bar, self._rows(body, *term), strict=True):
                        self._per_particle_vjp(body, path, row, values, out)

    def stiffness(self, body: str, values: Values) -> tuple[Array, Array, Array]:
        """Return density [kg/m^D], pressure-wave modulus [Pa] and viscosity 4/3 eta + zeta [Pa s] (N_b,)."""
        path, default = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
        terms = [(spec, self._theta(body, (path_, spec, e), values)) for path_, spec, e in self._terms_of(body)]
        modulus = sum(spec.wave_modulus(theta) for spec, theta in terms)
        viscosity = sum(spec.wave_viscosity(theta) for spec, theta in terms)
        return self._per_particle(body, path, default, values), np.asarray(modulus), np.asarray(viscosity)

    def terms_at(self, body: str, particle: int, values: Values) -> tuple[list[Any], list[Array]]:
        """Return the kernels' views of a body's terms, and the parameters of each (rows,), at one of its particles."""
        each = [(spec, self._theta(body, (path, spec, e), values)) for path, spec, e in self._terms_of(body)]
        thetas = [theta[:, [particle]] for _, theta in each]
        terms = [spec.kernel_term(theta) for (spec, _), theta in zip(each, thetas, strict=True)]
        return terms, [theta[:, 0] for theta in thetas]

    # --- the design --------------------------------------------------------------------------------------------------

    def design(self, inputs: Inputs) -> Array:
        """Return the quantities of `DESIGN` for every particle (Q, N)."""
        out = np.full((len(DESIGN), len(self.particles.x)), np.nan)  # a law need not have a Young's modulus
        out[MASS], out[VOLUME] = inputs.fields.mass, inputs.fields.volume * self.particles.room
        for quantity, part, g, row, columns in self._elastic_rows():
            out[quantity, part] = inputs.terms[g][0][row, columns]
        return out

    def add_beside(self, bar: Inputs, beside: TrackBar) -> None:
        """Add to the cotangent of the inputs what terms and quantities depend on directly, and not by the motion."""
        if beside.design is not None:
            self.add_design_bar(bar, beside.design)
        if beside.strength is not None:
            bar.strength += beside.strength
        if beside.rest_length is not None:
            bar.rest += beside.rest_length
        if beside.friction is not None:
            bar.friction += beside.friction
        if beside.weights is not None:
            bar.weights += beside.weights
        if beside.rest is not None:
            bar.state.x += beside.rest
        for group, more in zip(bar.terms, beside.terms or (), strict=False):
            for theta_bar, part in zip(group, more, strict=True):
                theta_bar += part

    def add_design_bar(self, bar: Inputs, design_bar: Array) -> None:
        """Add the contribution of the design's cotangent (Q, N) to the cotangent of the inputs."""
        bar.fields.mass += design_bar[MASS]
        bar.fields.volume += design_bar[VOLUME] * self.particles.room
        for quantity, part, g, row, columns in self._elastic_rows():
            bar.terms[g][0][row, columns] += design_bar[quantity, part]

    def _elastic_rows(self) -> Iterator[tuple[int, slice, int, int, slice]]:
        """Yield (row of the design, particles of a body, its group, row of its elastic term, its columns there)."""
        for g, bodies in enumerate(self._groups()):
            begin = self.particles.of(bodies[0]).start
            for body in bodies:
                part, law = self.particles.of(body), cast(Any, self.scene.bodies[body].material.elastic.value)
                for quantity in (STIFFNESS, RATIO):
                    if DESIGN[quantity] in law.parameters:
                        row = law.parameters.index(DESIGN[quantity])
                        yield quantity, part, g, row, slice(part.start - begin, part.stop - begin)

    # --- boundaries -------------------------------------------------------------------------------------------------

    def _planes(self) -> list[tuple[str, Plugin]]:
        """Return path and condition of every plane, in the order of the model."""
        origin, planes = np.zeros((1, self.scene.dim)), []
        for name, chosen in self.scene.boundaries.items():
            spec: Any = boundary(self.scene, name)
            places = spec.places(origin, np.array(self.scene.world.size))
            planes += [(f"boundaries.{name}.{chosen.name}", spec)] * len(places)
        return planes

    def _rubbing(self) -> list[tuple[str, Any]]:
        """Return path and spec of every plane, and of bodies that meet each other."""
        contact = self.scene.world.contact or BodyContact()
        return [*self._planes(), *[("world.contact", contact)] * self.scene.bodies_meet]

    def _coefficients(self, values: Values) -> Array:
        return np.array([getattr(updated(s, path, values), "coefficient", 0.0) for path, s in self._rubbing()])

    def _coefficients_vjp(self, values: Values, bar: Inputs, out: dict[str, Array]) -> None:
        for (path, _), coefficient_bar in zip(self._rubbing(), bar.coefficients, strict=True):
            collect(path, {"coefficient": coefficient_bar}, out)

    def _moves(self, values: Values) -> Array:
        """Return displacement and rotation of every plane (planes, D + 1) or (planes, 6)."""
        dim = self.scene.dim
        specs = [updated(spec, path, values) for path, spec in self._planes()]
        rows = [spec.carried_to(dim) if hasattr(spec, "carried_to") else [0.0] * (3 * dim - 3) for spec in specs]
        return np.array(rows).reshape(len(specs), 3 * dim - 3)

    def _moves_vjp(self, bar: Inputs, out: dict[str, Array]) -> None:
        dim = self.scene.dim
        for (path, spec), row in zip(self._planes(), bar.moves, strict=True):
            if getattr(spec, "moves", False):
                collect(path, {"displacement": row[:dim], "rotation": row[dim:]}, out)


def require_complete(load: Load, path: str, cotangents: Mapping[str, Any], out: dict[str, Array]) -> None:
    """Raise a UsageError if a load returns no cotangent for a requested gradient, which would silently be 0."""
    for name in type(load).model_fields:
        base = f"{path}.{name}"
        requested = is_differentiable(type(load), name) and any(f"{key}.".startswith(f"{base}.") for key in out)
        if requested and name not in cotangents:
            raise UsageError(
                f"{base}: the load '{load.name}' declares `{name}` differentiable, but its apply_vjp returns no "
                f"cotangent of it; it returns those of {listed(cotangents)}"
            )
