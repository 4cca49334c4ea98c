"""discrete event with probability sigmoid(x) (epidemic/Gillespie/gymnax kind; StochasticAD and CompetingClocks.jl#38): score-function gradient, the only sampled gradient there is. Right: dJ = (r1-r0) p (1-p) = 0.4702 for r1 = 3, r0 = 1, x = 0.5; the estimator is unbiased; without the -p it is biased."""

import math

theta = [0.5]


def _p(x):
    return 1 / (1 + math.exp(-x[0]))


def _b(x, w):
    return 1.0 if 0.5 * math.erfc(-w[0] / 2**0.5) < _p(x) else 0.0


def cost(x, w):
    return 1.0 + 2.0 * _b(x, w)


def score(x, w):
    return [cost(x, w) * (_b(x, w) - _p(x))]


def broken(x, w):
    return [cost(x, w) * _b(x, w)]


def pathwise(x, w):
    return [0.0]
