"""Motion models: how a control sample moves the vehicle, as an increment in its own frame.

pose' = pose composed with increment(corrected control, dt). The models here are known to the compiled kernels
(`setup`); any other object with the same methods and `compiled = False` works too, more slowly.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol

import msgspec
import numpy as np

from kalmap.geometry.se2 import exp_position, rotate
from kalmap.kernels import layout
from kalmap.records import ConfigError, MotionConfig

BIAS_CODES = {
    "steering_offset": layout.BIAS_STEERING_OFFSET,
    "steering_scale": layout.BIAS_STEERING_SCALE,
    "speed_scale": layout.BIAS_SPEED_SCALE,
    "turn_rate_offset": layout.BIAS_TURN_RATE_OFFSET,
    "turn_rate_scale": layout.BIAS_TURN_RATE_SCALE,
    "course_offset": layout.BIAS_COURSE_OFFSET,
}


class Bias(msgspec.Struct, frozen=True):
    """A constant error estimated as a state: its name, the prior's standard deviation and its mean."""

    name: str
    sigma: float
    mean: float = 0.0


class MotionModel(Protocol):
    """What the filter asks of a motion model: plain attributes will do for the properties."""

    @property
    def compiled(self) -> bool:
        """Whether the kernels know it; False for any model but the built-in ones."""
        ...

    @property
    def control_size(self) -> int:
        """How many numbers a control sample has."""
        ...

    @property
    def biases(self) -> tuple[Bias, ...]:
        """The constant errors to be estimated as states, in the order that `increment` takes them."""
        ...

    def increment(self, control: np.ndarray, biases: np.ndarray, dt: float) -> np.ndarray:
        """(..., c) raw control and (..., nb) biases -> (..., 3) increment m, m, rad."""
        ...

    def control_covariance(self, control: np.ndarray, dt: float) -> np.ndarray:
        """(c, c) noise of one raw control sample."""
        ...


class _Biased(msgspec.Struct, frozen=True, kw_only=True):
    """What the built-in models share: biases, and control noise that may be white in time.

    sigma_speed m/s, ratio_speed; the turn's sigma rad or rad/s and its ratio stand in the model itself.
    sample_time s, exact_standstill: see `MotionConfig`.
    """

    biases: tuple[Bias, ...] = ()
    sigma_speed: float = 0.3
    ratio_speed: float = 0.0
    sample_time: float = 0.0
    exact_standstill: bool = False
    compiled: ClassVar[bool] = True
    control_size: ClassVar[int] = 2
    bias_names: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for bias in self.biases:
            if bias.name not in self.bias_names:
                raise ConfigError(
                    f"motion.biases: {type(self).__name__} has no {bias.name!r}; it has {', '.join(self.bias_names)}"
                )
        if len({bias.name for bias in self.biases}) < len(self.biases):
            raise ConfigError("motion.biases: a name stands there twice")

    def corrected(self, control: np.ndarray, biases: np.ndarray) -> np.ndarray:
        """The control with the constant errors taken out. The last entry is the turn's."""
        control = np.asarray(control, dtype=float)
        shape = np.broadcast_shapes(control.shape[:-1], np.shape(biases)[:-1])
        speed, turn, offset = np.ones(shape), np.ones(shape), np.zeros(shape)
        for i, bias in enumerate(self.biases):
            if bias.name == "speed_scale":
                speed = speed + biases[..., i]
            elif bias.name.endswith("_scale"):
                turn = turn + biases[..., i]
            elif bias.name != "course_offset":
                offset = offset + biases[..., i]
        ahead = [speed * control[..., k] for k in range(self.control_size - 1)]
        return np.stack([*ahead, turn * control[..., -1] + offset], axis=-1)

    def turned(self, step: np.ndarray, biases: np.ndarray) -> np.ndarray:
        """The increment with its way turned by the course offset, if that is among the biases."""
        for i, bias in enumerate(self.biases):
            if bias.name == "course_offset":
                angle = biases[..., i]
                step = np.concatenate([rotate(angle, step[..., :2]), step[..., 2:]], axis=-1)
        return step

    def _turn_noise(self) -> tuple[float, float]:
        raise AttributeError("overridden by every model")

    def control_covariance(self, control: np.ndarray, dt: float) -> np.ndarray:
        """(c, c), from the sigmas."""
        if self.exact_standstill and not control.any():
            return np.zeros((2, 2))
        sigma, ratio = self._turn_noise()
        scale = self.sample_time / dt if self.sample_time > 0.0 and dt > 0.0 else 1.0
        speed = self.sigma_speed**2 + (self.ratio_speed * control[0]) ** 2
        return scale * np.diag([speed, sigma**2 + (ratio * control[-1]) ** 2])

    def fill(self, setup: np.ndarray) -> None:
        """Write the model's part of the kernels' setup vector."""
        setup[layout.SIGMA_SPEED], setup[layout.RATIO_SPEED] = self.sigma_speed, self.ratio_speed
        setup[layout.SIGMA_TURN], setup[layout.RATIO_TURN] = self._turn_noise()
        setup[layout.SAMPLE_TIME] = self.sample_time
        setup[layout.EXACT_STANDSTILL] = self.exact_standstill
        setup[layout.BIAS_COUNT] = len(self.biases)
        for i, bias in enumerate(self.biases):
            setup[layout.BIAS_CODE + i] = BIAS_CODES[bias.name]


class _Steered(_Biased, frozen=True, kw_only=True):
    """What the steered vehicles share. sigma_steering: rad."""

    sigma_steering: float = float(np.deg2rad(3.0))
    bias_names: ClassVar[tuple[str, ...]] = (
        "steering_offset",
        "steering_scale",
        "speed_scale",
        "course_offset",
    )

    def _turn_noise(self) -> tuple[float, float]:
        return self.sigma_steering, 0.0


class VelocitySteering(_Steered, frozen=True, kw_only=True, tag=True):
    """Bailey's vehicle: speed m/s of the front-wheel point and steering rad, one Euler step a sample.

    x += V dt cos(G + phi), y += V dt sin(G + phi), phi += V dt sin(G) / wheelbase.
    """

    wheelbase: float = 4.0

    def increment(self, control: np.ndarray, biases: np.ndarray, dt: float) -> np.ndarray:
        """(..., 2) -> (..., 3)."""
        control = self.corrected(control, biases)
        distance, steering = control[..., 0] * dt, control[..., 1]
        lateral = distance * np.sin(steering)
        step = np.stack([distance * np.cos(steering), lateral, lateral / self.wheelbase], axis=-1)
        return self.turned(step, np.asarray(biases))

    def fill(self, setup: np.ndarray) -> None:
        """Write the model's part of the kernels' setup vector."""
        super().fill(setup)
        setup[layout.MOTION], setup[layout.WHEELBASE] = layout.MOTION_VELOCITY_STEERING, self.wheelbase


class Ackermann(_Steered, frozen=True, kw_only=True, tag=True):
    """A car's rear-axle pose from the speed of one rear wheel and the steering angle, on exact arcs.

    v = v_encoder / (1 - encoder_offset / wheelbase tan(alpha)), turn rate v / wheelbase tan(alpha).
    encoder_offset: m, from the axle's centre to the encoder's wheel, positive to the left.
    """

    wheelbase: float = 2.83
    encoder_offset: float = 0.0

    def increment(self, control: np.ndarray, biases: np.ndarray, dt: float) -> np.ndarray:
        """(..., 2) -> (..., 3)."""
        control = self.corrected(control, biases)
        tangent = np.tan(control[..., 1])
        distance = control[..., 0] * dt / (1.0 - self.encoder_offset / self.wheelbase * tangent)
        return self.turned(_arc(distance, distance * tangent / self.wheelbase), np.asarray(biases))

    def fill(self, setup: np.ndarray) -> None:
        """Write the model's part of the kernels' setup vector."""
        super().fill(setup)
        setup[layout.MOTION], setup[layout.WHEELBASE] = layout.MOTION_ACKERMANN, self.wheelbase
        setup[layout.ENCODER_OFFSET] = self.encoder_offset


class Unicycle(_Biased, frozen=True, kw_only=True, tag=True):
    """Speed m/s and turn rate rad/s, held for the sample: an exact arc."""

    sigma_turn_rate: float = float(np.deg2rad(3.0))
    ratio_turn_rate: float = 0.0
    bias_names: ClassVar[tuple[str, ...]] = ("turn_rate_offset", "turn_rate_scale", "speed_scale")

    def _turn_noise(self) -> tuple[float, float]:
        return self.sigma_turn_rate, self.ratio_turn_rate

    def increment(self, control: np.ndarray, biases: np.ndarray, dt: float) -> np.ndarray:
        """(..., 2) -> (..., 3)."""
        control = self.corrected(control, biases)
        return _arc(control[..., 0] * dt, control[..., 1] * dt)

    def fill(self, setup: np.ndarray) -> None:
        """Write the model's part of the kernels' setup vector."""
        super().fill(setup)
        setup[layout.MOTION] = layout.MOTION_UNICYCLE


class Increments(_Biased, frozen=True, kw_only=True, tag=True):
    """Odometry that already is dx m, dy m, dtheta rad in the previous frame.

    Noise where the log gives none: ratio_distance of the way on both axes, sigma_rotation rad a step and
    ratio_rotation of the turn. The speed scale acts on both distances.
    """

    ratio_distance: float = 0.1
    sigma_rotation: float = float(np.deg2rad(0.5))
    ratio_rotation: float = 0.1
    control_size: ClassVar[int] = 3
    bias_names: ClassVar[tuple[str, ...]] = ("turn_rate_offset", "turn_rate_scale", "speed_scale")

    def _turn_noise(self) -> tuple[float, float]:
        return self.sigma_rotation, self.ratio_rotation

    def increment(self, control: np.ndarray, biases: np.ndarray, dt: float) -> np.ndarray:
        """(..., 3) -> (..., 3). The duration plays no part."""
        return self.corrected(control, biases)

    def control_covariance(self, control: np.ndarray, dt: float) -> np.ndarray:
        """(3, 3), from the ratios."""
        if self.exact_standstill and not control.any():
            return np.zeros((3, 3))
        along = self.ratio_distance**2 * (control[0] ** 2 + control[1] ** 2)
        return np.diag([along, along, self.sigma_rotation**2 + (self.ratio_rotation * control[2]) ** 2])

    def fill(self, setup: np.ndarray) -> None:
        """Write the model's part of the kernels' setup vector."""
        super().fill(setup)
        setup[layout.MOTION] = layout.MOTION_INCREMENTS
        setup[layout.RATIO_DISTANCE] = self.ratio_distance
        setup[layout.SIGMA_ROTATION], setup[layout.RATIO_ROTATION] = self.sigma_rotation, self.ratio_rotation


BuiltInMotion = VelocitySteering | Ackermann | Unicycle | Increments


def _arc(distance: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The increment of a constant twist: distance m along an arc that turns by angle rad."""
    angle = np.asarray(angle, dtype=float)
    along = np.stack([distance + 0.0 * angle, 0.0 * angle], axis=-1)
    return np.concatenate([exp_position(angle, along), angle[..., None]], axis=-1)


def motion_from_config(config: MotionConfig) -> BuiltInMotion:
    """The built-in model that a configuration describes. Raises ConfigError on biases it does not have."""
    sigmas = {
        "steering_offset": float(np.deg2rad(config.prior_steering_offset_deg)),
        "steering_scale": config.prior_steering_scale,
        "speed_scale": config.prior_speed_scale,
        "turn_rate_offset": float(np.deg2rad(config.prior_turn_rate_offset_deg)),
        "turn_rate_scale": config.prior_turn_rate_scale,
        "course_offset": float(np.deg2rad(config.prior_course_offset_deg)),
    }
    for name in config.biases:
        if name not in sigmas:
            raise ConfigError(f"motion.biases: {name!r} is none of {', '.join(sigmas)}")
    means = {
        "steering_offset": float(np.deg2rad(config.mean_steering_offset_deg)),
        "steering_scale": config.mean_steering_scale,
        "speed_scale": config.mean_speed_scale,
        "turn_rate_offset": float(np.deg2rad(config.mean_turn_rate_offset_deg)),
        "turn_rate_scale": config.mean_turn_rate_scale,
        "course_offset": float(np.deg2rad(config.mean_course_offset_deg)),
    }
    biases = tuple(Bias(name, sigmas[name], means[name]) for name in config.biases)
    speed: dict[str, Any] = {
        "sigma_speed": config.sigma_speed,
        "ratio_speed": config.sigma_speed_ratio,
        "sample_time": config.sample_time,
        "exact_standstill": config.exact_standstill,
    }
    steering = float(np.deg2rad(config.sigma_steering_deg))
    if config.model == "velocity-steering":
        return VelocitySteering(biases=biases, wheelbase=config.wheelbase, sigma_steering=steering, **speed)
    if config.model == "ackermann":
        return Ackermann(
            biases=biases,
            wheelbase=config.wheelbase,
            encoder_offset=config.encoder_offset,
            sigma_steering=steering,
            **speed,
        )
    if config.model == "unicycle":
        return Unicycle(
            biases=biases,
            sigma_turn_rate=float(np.deg2rad(config.sigma_turn_rate_deg)),
            ratio_turn_rate=config.sigma_turn_rate_ratio,
            **speed,
        )
    if config.model != "increments":
        raise ConfigError(
            f"motion.model: {config.model!r} is none of velocity-steering, ackermann, unicycle, increments"
        )
    return Increments(
        biases=biases,
        exact_standstill=config.exact_standstill,
        ratio_distance=config.sigma_distance_ratio,
        sigma_rotation=float(np.deg2rad(config.sigma_rotation_deg)),
        ratio_rotation=config.sigma_rotation_ratio,
    )
