"""From values by key path to the engine's inputs, and from their cotangent back to gradients by path.

A value is one number (`per: body`), one a group or one a particle; a path without a value keeps what the scene
says. `inputs` is the map, `gradient` its adjoint; each part of one stands beside its part of the other.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np

from cqrun.plugin.contract import Array, Plugin, is_differentiable
from cqrun.engine.model import Inputs
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.loads.gravity import Gravity
from cqrun.loads.load import Load
from cqrun.objectives.design import DESIGN, MASS, RATIO, STIFFNESS, VOLUME
from cqrun.build.actuation import Actuation
from cqrun.build.rest_shape import Geometry
from cqrun.build.particles import Particles, stress_key
from cqrun.build.regions import boundary
from cqrun.scene.schema import Scene
from cqrun.state import ParticleFields, State

Values = Mapping[str, Array]
"""Key path -> value: a scalar array (), one a group (G,), or one a particle (N,)."""


class Assembly:
    """The map from values to inputs for one scene.

    Args:
        scene: resolved.
        particles: its particles.
        sequence: which of a scene's random activations drives the actuators.
    """

    def __init__(self, scene: Scene, particles: Particles, sequence: int = 0) -> None:
        self.scene, self.particles, self.sequence = scene, particles, sequence
        self.actuation, self.geometry = Actuation(scene, particles), Geometry(scene, particles)
        self.loads: list[tuple[str, Load]] = [
            (f"loads.{name}.{chosen.name}", chosen.value)  # type: ignore[misc]
            for name, chosen in scene.loads.items()
        ]
        self.loads.append(("world", Gravity(gravity=list(scene.world.gravity))))
        self.loads.sort(key=lambda item: item[1].order)
        self.chosen = [particles.inside(load.body, load.region) for _, load in self.loads]

    def with_sequence(self, sequence: int) -> Assembly:
        """Return the same map driven by another of the random activations."""
        return Assembly(self.scene, self.particles, sequence)

    def reaches(self, path: str) -> bool:
        """Say whether the engine's inputs depend on a path (the start of a recording is not one)."""
        return not path.startswith("data.")

    # --- values -------------------------------------------------------------------------------------------

    def _others(self, body: str, path: str) -> list[tuple[Array, str, float]]:
        """Return where `material_of` has another value than that of a path: particles (N_b,), its path, the value."""
        base = f"bodies.{body}.material"
        suffix, found = path.removeprefix(f"{base}."), []
        for name, other in self.scene.bodies[body].material_of.items():
            own = other.value(suffix)
            if own is not None:
                found.append((self.particles.points[body].named(name), f"{base}_of.{name}.{suffix}", own))
        return found

    def _spread(self, body: str, path: str, own: float, values: Values) -> Array:
        """Return a value for each of a body's particles (N_b,)."""
        result = self._of_whole(body, path, own, values)
        for held, other, value in self._others(body, path):
            result[held] = float(np.asarray(values.get(other, value)).reshape(-1)[0])
        return result

    def _of_whole(self, body: str, path: str, own: float, values: Values) -> Array:
        """Return a value of a body's material for each of its particles (N_b,), those of other materials too."""
        n = self.particles.of(body)
        count = n.stop - n.start
        value = np.asarray(values.get(path, own), float)
        if value.ndim == 0:
            return np.full(count, float(value))
        if value.size == count:
            return value.reshape(-1).copy()
        labels = self.particles.labels(body)
        return np.where(labels >= 0, value.reshape(-1)[labels], own)

    def _spread_vjp(self, body: str, path: str, per_particle_bar: Array, values: Values, out: dict[str, Array]) -> None:
        """Add the cotangent of what `_spread` returns to out, for those of its paths that have a value."""
        left = per_particle_bar.copy()
        for held, other, _ in reversed(self._others(body, path)):
            if other in values:
                bar = out.setdefault(other, np.zeros(np.shape(values[other])))
                bar += left[held].sum()
            left[held] = 0.0
        self._of_whole_vjp(body, path, left, values, out)

    def _of_whole_vjp(
        self, body: str, path: str, per_particle_bar: Array, values: Values, out: dict[str, Array]
    ) -> None:
        """Add the cotangent of what `_of_whole` returns to out[path], if the path has a value."""
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
        for body in self.particles.names:
            state.v[self.particles.of(body)] = self._velocities(body, x, values)
        fields, _ = self._fields(volume, values)
        drive = self.actuation
        return Inputs(
            state, fields, self._terms(values), drive.activations(self.sequence, values), drive.strengths(values),
            self._coefficients(values), drive.weights(values), drive.rests(x),
        )  # fmt: skip

    def gradient(self, values: Values, bar: Inputs) -> dict[str, Array]:
        """Return the gradient by path, of each value's shape, from the cotangent of the inputs."""
        out = {path: np.zeros(np.shape(value)) for path, value in values.items()}
        x, volume = self.geometry.at_rest(values)
        x_bar = bar.state.x + self._velocities_vjp(x, values, bar, out) + self.actuation.rests_vjp(x, bar.rest)
        self.geometry.at_rest_vjp(values, x_bar, self._fields_vjp(volume, values, bar, out), out)
        self._terms_vjp(values, bar, out)
        self.actuation.activations_vjp(bar.activation, self.sequence, values, out)
        self.actuation.strengths_vjp(bar.strength, out)
        self.actuation.weights_vjp(bar.weights, out)
        self._coefficients_vjp(values, bar, out)
        return out

    # --- masses and loads -------------------------------------------------------------------------------------

    def _fields(self, volume: Array, values: Values) -> tuple[ParticleFields, list[Load]]:
        fields = ParticleFields.zeros(len(volume), self.scene.dim)
        fields.volume[:] = volume
        for body in self.particles.names:
            part = self.particles.of(body)
            path, own = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
            fields.mass[part] = self._spread(body, path, own, values) * fields.volume[part]
        loads = [updated(load, path, values) for path, load in self.loads]
        for load, chosen in zip(loads, self.chosen, strict=True):
            load.apply(fields, chosen)
        return fields, loads

    def _fields_vjp(self, volume: Array, values: Values, bar: Inputs, out: dict[str, Array]) -> Array:
        """Add to the gradients, and return the cotangent of the volumes (N,)."""
        fields, loads = self._fields(volume, values)
        fields_bar = copy.deepcopy(bar.fields)  # loads add to what they read; the cotangent given stays as it is
        steps = list(zip(self.loads, loads, self.chosen, strict=True))
        for (path, _), load, chosen in reversed(steps):
            cotangents = load.apply_vjp(fields, fields_bar, chosen)
            require_complete(load, path, cotangents, out)
            collect(path, cotangents, out)
        for body in self.particles.names:
            part = self.particles.of(body)
            path, own = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
            self._spread_vjp(body, path, fields_bar.mass[part] * volume[part], values, out)
            fields_bar.volume[part] += fields_bar.mass[part] * self._spread(body, path, own, values)
        return fields_bar.volume

    # --- velocities ---------------------------------------------------------------------------------------------

    def velocities(self, body: str, values: Values) -> Array:
        """Return a body's velocities at the start (N_b, D): v + spin x (x - centroid)."""
        return self._velocities(body, self.geometry.at_rest(values)[0], values)

    def _velocities(self, body: str, x: Array, values: Values) -> Array:
        base, spec = f"bodies.{body}", self.scene.bodies[body]
        v = numbers(f"{base}.velocity", spec.velocity, values)
        spin = numbers(f"{base}.spin", spec.spin, values)
        return np.asarray(v + self._arm(body, x) @ spin)

    def _arm(self, body: str, x: Array) -> Array:
        """Return the velocity of each particle by each entry of the spin (N_b, D, 1 or 3)."""
        own = x[self.particles.of(body)]
        r = own - own.mean(axis=0)
        if self.scene.dim == 2:
            return np.stack([-r[:, 1], r[:, 0]], axis=1)[:, :, None]
        return np.cross(np.eye(3)[None, :, :], r[:, None, :]).transpose(0, 2, 1)

    def _velocities_vjp(self, x: Array, values: Values, bar: Inputs, out: dict[str, Array]) -> Array:
        """Add to the gradients, and return the cotangent of the rest positions (N, D): v_bar x spin, less its mean."""
        x_bar = np.zeros(x.shape)
        for body in self.particles.names:
            part, base = self.particles.of(body), f"bodies.{body}"
            v_bar = bar.state.v[part]
            spin_bar = np.einsum("nds,nd->s", self._arm(body, x), v_bar)
            collect(base, {"velocity": v_bar.sum(axis=0), "spin": spin_bar}, out)
            spin = numbers(f"{base}.spin", self.scene.bodies[body].spin, values)
            if self.scene.dim == 2:
                r_bar = spin[0] * np.stack([v_bar[:, 1], -v_bar[:, 0]], axis=1)
            else:
                r_bar = np.cross(v_bar, spin)
            x_bar[part] = r_bar - r_bar.mean(axis=0)
        return x_bar

    # --- material terms -------------------------------------------------------------------------------------------

    def _terms_of(self, body: str) -> list[tuple[str, Any, str]]:
        """Return (path, spec, path of the elastic term) of each term of a body's stress."""
        material, base = self.scene.bodies[body].material, f"bodies.{body}.material"
        elastic = f"{base}.elastic.{material.elastic.name}"
        further = [(f"{base}.{name}", spec, elastic) for name, spec in material.terms.items()]
        return [(elastic, material.elastic.value, elastic), *further]

    def _rows(self, body: str, path: str, spec: Any, elastic: str) -> list[tuple[str, float]]:
        """Return path and the scene's own value of each row of theta; a term may read the elastic term's."""
        own = self.scene.bodies[body].material.elastic.value
        return [
            (f"{path}.{name}", getattr(spec, name))
            if name in type(spec).model_fields
            else (f"{elastic}.{name}", getattr(own, name))
            for name in spec.parameters
        ]

    def material(self, body: str, values: Values) -> dict[str, Array]:
        """Return every number of a body's material for each of its particles (N_b,), by its path."""
        rows = [(f"bodies.{body}.material.density", self.scene.bodies[body].material.density)]
        rows += [row for term in self._terms_of(body) for row in self._rows(body, *term)]
        return {path: self._spread(body, path, own, values) for path, own in rows}

    def _theta(self, body: str, term: tuple[str, Any, str], values: Values) -> Array:
        return np.array([self._spread(body, path, own, values) for path, own in self._rows(body, *term)])

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
                        self._spread_vjp(body, path, row, values, out)

    def stiffness(self, body: str, values: Values) -> tuple[Array, Array, Array]:
        """Return density [kg/m^D], pressure-wave modulus [Pa] and viscosity 4/3 eta + zeta [Pa s] (N_b,)."""
        path, own = f"bodies.{body}.material.density", self.scene.bodies[body].material.density
        terms = [(spec, self._theta(body, (path_, spec, e), values)) for path_, spec, e in self._terms_of(body)]
        modulus = sum(spec.wave_modulus(theta) for spec, theta in terms)
        viscosity = sum(spec.wave_viscosity(theta) for spec, theta in terms)
        return self._spread(body, path, own, values), np.asarray(modulus), np.asarray(viscosity)

    # --- the design --------------------------------------------------------------------------------------------------

    def design(self, inputs: Inputs) -> Array:
        """Return the quantities of `DESIGN`, of every particle (Q, N)."""
        out = np.full((len(DESIGN), len(self.particles.x)), np.nan)  # a law of one's own may have no Young's modulus
        out[MASS], out[VOLUME] = inputs.fields.mass, inputs.fields.volume * self.particles.room
        for which, part, g, row, own in self._elastic_rows():
            out[which, part] = inputs.terms[g][0][row, own]
        return out

    def add_design_bar(self, bar: Inputs, design_bar: Array) -> None:
        """Add to a cotangent of the inputs what comes from that of the design (Q, N)."""
        bar.fields.mass += design_bar[MASS]
        bar.fields.volume += design_bar[VOLUME] * self.particles.room
        for which, part, g, row, own in self._elastic_rows():
            bar.terms[g][0][row, own] += design_bar[which, part]

    def _elastic_rows(self) -> Iterator[tuple[int, slice, int, int, slice]]:
        """Yield a row of the design, a body's particles, its group, the row of its elastic term, their place there."""
        for g, bodies in enumerate(self._groups()):
            begin = self.particles.of(bodies[0]).start
            for body in bodies:
                part, law = self.particles.of(body), cast(Any, self.scene.bodies[body].material.elastic.value)
                for which in (STIFFNESS, RATIO):
                    if DESIGN[which] in law.parameters:
                        row = law.parameters.index(DESIGN[which])
                        yield which, part, g, row, slice(part.start - begin, part.stop - begin)

    # --- boundaries -------------------------------------------------------------------------------------------------

    def _planes(self) -> list[tuple[str, Plugin]]:
        """Return path and condition of every plane, in the model's order."""
        size, found = np.zeros((1, self.scene.dim)), []
        for name, chosen in self.scene.boundaries.items():
            spec: Any = boundary(self.scene, name)
            planes = spec.places(size, np.array(self.scene.world.size))
            found += [(f"boundaries.{name}.{chosen.name}", spec)] * len(planes)
        return found

    def _coefficients(self, values: Values) -> Array:
        return np.array([getattr(updated(s, path, values), "coefficient", 0.0) for path, s in self._planes()])

    def _coefficients_vjp(self, values: Values, bar: Inputs, out: dict[str, Array]) -> None:
        for (path, _), coefficient_bar in zip(self._planes(), bar.coefficients, strict=True):
            collect(path, {"coefficient": coefficient_bar}, out)


# --- values of a plug-in's fields ---------------------------------------------------------------------------------


def numbers(path: str, own: list[float], values: Values) -> Array:
    """Return a list of numbers with the values that its entries have."""
    return np.array([float(np.asarray(values.get(f"{path}.{k}", entry)).reshape(-1)[0]) for k, entry in enumerate(own)])


def updated(spec: Any, path: str, values: Values) -> Any:
    """Return a plug-in with the values that its differentiable fields have."""
    changes: dict[str, Any] = {}
    for name in type(spec).model_fields:
        if is_differentiable(type(spec), name):
            own = getattr(spec, name)
            if isinstance(own, list):
                changes[name] = numbers(f"{path}.{name}", own, values).tolist()
            elif f"{path}.{name}" in values:
                changes[name] = float(np.asarray(values[f"{path}.{name}"]).reshape(-1)[0])
    return spec.model_copy(update=changes)


def require_complete(load: Load, path: str, cotangents: Mapping[str, Any], out: dict[str, Array]) -> None:
    """Refuse cotangents of a load that lack a wanted one: its gradient would be 0 without a word."""
    for name in type(load).model_fields:
        base = f"{path}.{name}"
        wanted = is_differentiable(type(load), name) and any(f"{key}.".startswith(f"{base}.") for key in out)
        if wanted and name not in cotangents:
            raise UsageError(
                f"{base}: the load '{load.name}' declares `{name}` differentiable, and its apply_vjp returns no "
                f"cotangent of it; it returns those of {listed(cotangents)}"
            )


def collect(path: str, cotangents: Mapping[str, Any], out: dict[str, Array]) -> None:
    """Add the cotangents of a part's fields, numbers or lists of them, to the gradients that are wanted."""
    for name, cotangent in cotangents.items():
        base = f"{path}.{name}" if name else path
        entries = {base: cotangent} if np.ndim(cotangent) == 0 else {f"{base}.{k}": c for k, c in enumerate(cotangent)}
        for key, bar in entries.items():
            if key in out:
                out[key] += bar
