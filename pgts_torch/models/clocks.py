"""Whether a clock is read for rewards and truncation alone: the same steps at other counts, in a short trial."""

import numpy as np

from pgts_torch.errors import ModelMismatch, PgtsError
from pgts_torch.models.answers import Step
from pgts_torch.models.snapshots import Clock
from pgts_torch.models.stepper import Stepper
from pgts_torch.models.steps import bits
from pgts_torch.models.trial import environment_code, reset
from pgts_torch.seeding import SharedGenerators, numpy_stream

_COUNTS, _FIRST, _EACH = 160, 64, 4
"""At how many other counts steps are made: at each of the first ones, then at the last one before truncation and at
random ones. At how many of them the same step is made."""

_LONGEST = 40
"""The most steps of an episode of the trial."""


def trusted_clock(stepper: Stepper) -> Clock | None:
    """The clock of an environment, if it passes `check_clock`. What the environment raises there is reported when it
    stops a training."""
    try:
        with SharedGenerators(0, "clock"):
            if stepper.clock is not None:
                check_clock(stepper, stepper.clock)
            return stepper.clock
    except PgtsError:
        return None
    finally:
        stepper.steps = 0


def check_clock(stepper: Stepper, clock: Clock) -> str:
    """Make steps at other counts than those at which a random walk comes to them: they must do the same, but for what
    follows from `Clock`.

    Args:
        stepper: of an instance that is in a state of this function's own afterwards.

    Returns:
        What was found, in words.

    Raises:
        ModelMismatch: what follows a step depends on the count otherwise.
        Failed: the environment raises.
    """
    random, tried, left = numpy_stream(0, "check_clock"), 0, 0
    while tried < _COUNTS:
        if left == 0:
            reset(stepper.env, seed=int(random.integers(2**31)))
            here, left = stepper.adapter.get_state(stepper.env), _LONGEST
        action, key = stepper.actions[int(random.integers(len(stepper.actions)))], int(random.integers(2**31))
        step = _step(stepper, here.data, action, key)
        if step.reading is None:
            raise ModelMismatch(f"reward and truncation are not those of {clock.name} alone")
        for _ in range(_EACH):
            count = _count(tried, step.reading.limit, random)
            found = _step(stepper, clock.at(here, count).data, action, key)
            if _look(stepper, stepper.at_count(step, count + 1)) != _look(stepper, found):
                raise ModelMismatch(f"what follows action {action!r} depends on {clock.name}, as at {count}")
            tried += 1
        here, left = step.child.snapshot, 0 if step.discount == 0 or step.child.snapshot.cut else left - 1
    return f"{tried} steps at other values of {clock.name} do the same"


def _count(tried: int, limit: int, random: np.random.Generator) -> int:
    if tried < min(_FIRST, limit):
        return tried
    return limit - 1 if tried % _EACH == 0 else int(random.integers(limit))


def _step(stepper: Stepper, data: object, action: object, key: int) -> Step:
    with environment_code():
        return stepper.follow(data, action, key, 1, None)


def _look(stepper: Stepper, step: Step) -> tuple[object, ...]:
    """Everything that a search and a critic see of a step."""
    seen = step.child
    with environment_code():
        shown = stepper.observation(seen.snapshot.data) if stepper.observes_late else seen.observation
    return step.reward, step.discount, seen.snapshot.name, step.random, bits(shown)
