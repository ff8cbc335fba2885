"""Gradients and steps of small networks of dense layers as compiled loops, a minibatch a call (`DenseSteps`).

Products are those of BLAS, by blocks of rows that it computes in one thread. Sums, and so bits, have another order than
torch's; tanh is a rational function with an error of a few roundings, because the one of the C library takes longer
than the products.
"""

import math

import numpy as np

from pgts_torch.agent.optimisers import BETAS
from pgts_torch.compiled import allocating, jit

VALUES, CLIPPED, FREE, TARGETS = range(4)
"""What is minimised: squares of values off their targets; a clipped objective, or one that is not, from the policy as
it is; the divergence from a target policy."""

_LARGEST = np.float32(7.90531110763549805)
_ABOVE = tuple(
    map(np.float32, (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08))
)
_ABOVE_1, _ABOVE_2, _ABOVE_3 = map(np.float32, (1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03))
_BELOW_0, _BELOW_1 = map(np.float32, (1.19825839466702e-06, 1.18534705686654e-04))
_BELOW_2, _BELOW_3 = map(np.float32, (2.26843463243900e-03, 4.89352518554385e-03))
_ABOVE_4, _ABOVE_5, _ABOVE_6, _ABOVE_7 = _ABOVE
"""Coefficients of x^13, x^11, ... over x^6, x^4, ..., as in Eigen."""

_DOT = 8192


@jit
def _tanh(x):  # type: ignore[no-untyped-def]
    x = _LARGEST if x > _LARGEST else x  # what is not a number stays so
    x = -_LARGEST if x < -_LARGEST else x
    s = x * x
    above = ((_ABOVE_4 * s + _ABOVE_5) * s + _ABOVE_6) * s + _ABOVE_7
    above = ((above * s + _ABOVE_1) * s + _ABOVE_2) * s + _ABOVE_3
    return x * above / (((_BELOW_0 * s + _BELOW_1) * s + _BELOW_2) * s + _BELOW_3)


@allocating
def _forward(theta_D, size_L, is_tanh, input_NX):  # type: ignore[no-untyped-def]
    """The input and what each layer makes of it, with its activation but for the last one."""
    values, at = [input_NX], 0
    for k in range(len(size_L) - 1):
        inputs, outputs = size_L[k], size_L[k + 1]
        weight = theta_D[at : at + outputs * inputs].reshape(outputs, inputs)
        bias = theta_D[at + outputs * inputs : at + outputs * inputs + outputs]
        at += outputs * (inputs + 1)
        y = np.dot(values[k], weight.T)
        is_last = k == len(size_L) - 2
        for n in range(len(y)):
            if is_last:
                for j in range(outputs):
                    y[n, j] += bias[j]
            elif is_tanh:
                for j in range(outputs):
                    y[n, j] = _tanh(y[n, j] + bias[j])
            else:
                for j in range(outputs):
                    above = y[n, j] + bias[j]
                    y[n, j] = np.float32(0) if above < 0 else above
        values.append(y)
    return values


@allocating
def outputs(theta_D, size_L, is_tanh, input_NX, rows, out_ND):  # type: ignore[no-untyped-def]
    """Write the outputs; all others as in `gradient`."""
    for start in range(0, len(input_NX), rows):
        end = min(start + rows, len(input_NX))
        out_ND[start:end] = _forward(theta_D, size_L, is_tanh, input_NX[start:end])[-1]


@allocating
def choices(theta_D, size_L, is_tanh, input_NX, random_NA, rows, action_N):  # type: ignore[no-untyped-def]
    """Write the actions with the largest exp(output) / random number. Return whether all outputs are finite."""
    for start in range(0, len(input_NX), rows):
        out_ND = _forward(theta_D, size_L, is_tanh, input_NX[start : start + rows])[-1]
        for n in range(len(out_ND)):
            best, largest = np.float32(-1), out_ND[n].max()
            for a in range(out_ND.shape[1]):
                score = np.float32(math.exp(out_ND[n, a] - largest)) / random_NA[start + n, a]
                if score > best:
                    best, action_N[start + n] = score, a
            if not np.isfinite(out_ND[n].sum()):
                return False
    return True


@allocating
def _backward(theta_D, size_L, is_tanh, values, down, gradient_D):  # type: ignore[no-untyped-def]
    """Add the gradient in the weights, from that in the outputs."""
    at = len(theta_D)
    for k in range(len(size_L) - 2, -1, -1):
        inputs, outputs = size_L[k], size_L[k + 1]
        at -= outputs * (inputs + 1)
        before = values[k]
        of_weight = gradient_D[at : at + outputs * inputs]
        of_weight += np.dot(down.T, before).reshape(-1)
        of_bias = gradient_D[at + outputs * inputs : at + outputs * inputs + outputs]
        for n in range(len(down)):
            for j in range(outputs):
                of_bias[j] += down[n, j]
        if k:
            below = np.dot(down, theta_D[at : at + outputs * inputs].reshape(outputs, inputs))
            for n in range(len(below)):
                if is_tanh:
                    for j in range(inputs):
                        below[n, j] *= np.float32(1) - before[n, j] * before[n, j]
                else:
                    for j in range(inputs):
                        below[n, j] = below[n, j] if before[n, j] > 0 else np.float32(0)
            down = below


@jit
def _of_values(out_ND, action_N, y_N, count, down_ND):  # type: ignore[no-untyped-def]
    """Write the gradient of the sum of (out[a] - y)^2 / count. Return that."""
    loss = 0.0
    for n in range(len(out_ND)):
        a = action_N[n] if out_ND.shape[1] > 1 else 0
        off = out_ND[n, a] - y_N[n]
        for d in range(out_ND.shape[1]):
            down_ND[n, d] = 0
        down_ND[n, a] = np.float32(2 / count) * off
        loss += off * off
    return loss / count


@allocating
def _log_softmax(out_ND):  # type: ignore[no-untyped-def]
    for n in range(len(out_ND)):
        most, total = out_ND[n].max(), np.float32(0)
        for a in range(out_ND.shape[1]):
            out_ND[n, a] -= most
            total += math.exp(out_ND[n, a])
        total = np.float32(math.log(total))
        for a in range(out_ND.shape[1]):
            out_ND[n, a] -= total


@jit
def _of_policy(form, log_NA, before_NA, advantage_NA, weight_N, count, low, high, coef, down_NA):  # type: ignore[no-untyped-def]
    """Write the gradient in the logits of what `PPOUpdate.objective`, or a fit to a target policy, minimises. Return
    the loss, and the KL divergence of pi from the policy before."""
    loss = divergence = 0.0
    for n in range(len(log_NA)):
        weight, gain, apart, total = weight_N[n] / np.float32(count), 0.0, 0.0, np.float32(0)
        for a in range(log_NA.shape[1]):
            log = log_NA[n, a]
            if form == FREE:
                before_NA[n, a] = log
            before = before_NA[n, a]
            pi, was = math.exp(log), math.exp(before)
            if was > 0:
                apart += was * (before - log)
            if form == TARGETS:
                down_NA[n, a] = -weight * was
            else:
                advantage, ratio = advantage_NA[n, a], math.exp(log - before)
                free, clipped = ratio * advantage, min(max(ratio, low), high) * advantage
                least = clipped if clipped < free else free
                slope = advantage if least == free else np.float32(0)
                if coef != 0:
                    slope -= coef * (log + np.float32(1))
                gain += was * least
                down_NA[n, a] = -(pi * slope) * weight
            total += down_NA[n, a]
        for a in range(log_NA.shape[1]):
            down_NA[n, a] -= math.exp(log_NA[n, a]) * total
        loss += weight * (apart if form == TARGETS else -gain)
        divergence += weight * apart
    return loss, divergence


@allocating
def gradient(theta_D, size_L, is_tanh, form, given, count, numbers, rows, gradient_E):  # type: ignore[no-untyped-def]
    """Write the gradient of a minibatch, and after it the loss and the KL divergence.

    Args:
        theta_D: the weights of all layers, each followed by its biases.
        size_L: how many inputs there are, and how many outputs each layer has.
        given: inputs [N, X], two columns [N, A] and one [N]; of values: inputs, nothing, nothing, targets, actions.
        count: the rows of the minibatch in all processes.
        numbers: low, high, coef.
        rows: in a block.
    """
    input_NX, one_NA, other_NA, last_N, action_N = given
    low, high, coef = numbers
    gradient_E[:] = 0
    gradient_D = gradient_E[: len(theta_D)]
    for start in range(0, len(input_NX), rows):
        end = min(start + rows, len(input_NX))
        values = _forward(theta_D, size_L, is_tanh, input_NX[start:end])
        out_ND = values[-1]
        down_ND = np.empty_like(out_ND)
        loss, divergence = 0.0, 0.0
        if form == VALUES:
            loss = _of_values(out_ND, action_N[start:end], last_N[start:end], count, down_ND)
        else:
            _log_softmax(out_ND)
            loss, divergence = _of_policy(
                form,
                out_ND,
                one_NA[start:end],
                other_NA[start:end],
                last_N[start:end],
                count,
                np.float32(low),
                np.float32(high),
                np.float32(coef),
                down_ND,
            )
        gradient_E[-2] += loss
        gradient_E[-1] += divergence
        _backward(theta_D, size_L, is_tanh, values, down_ND, gradient_D)


@allocating
def _square(x_D):  # type: ignore[no-untyped-def]
    """The sum of squares, by pieces that BLAS sums in one thread."""
    total = 0.0
    for start in range(0, len(x_D), _DOT):
        total += np.dot(x_D[start : start + _DOT], x_D[start : start + _DOT])
    return total


@allocating
def descend(theta_D, gradient_D, first_D, second_D, longest, epsilon, rate):  # type: ignore[no-untyped-def]
    """Take a step of Adam (`Optimiser`). Return the norm of the gradient, and a number that is finite as the weights
    are."""
    norm = math.sqrt(_square(gradient_D))
    scale = np.float32(longest / norm) if norm > longest else np.float32(1)
    epsilon, rate = np.float32(epsilon), np.float32(rate)
    for d in range(len(theta_D)):
        gradient = gradient_D[d] * scale
        first_D[d] += np.float32(1 - BETAS[0]) * (gradient - first_D[d])
        second_D[d] = second_D[d] * np.float32(BETAS[1]) + np.float32(1 - BETAS[1]) * gradient * gradient
        theta_D[d] += first_D[d] / (np.sqrt(second_D[d]) + epsilon) * rate
    return norm, _square(theta_D)
