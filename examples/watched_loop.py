"""Adam on the start of a ball on a spring floor, whose gradient forgets the damper from iteration 200 on: the log names it."""

import numpy as np
from numpy_loop import cost, forgetful, gradient, theta

import bench

if __name__ == "__main__":
    watch = bench.watch(cost, every=20, out="gradient.csv", share=0.5)
    mean, square = np.zeros(2), np.zeros(2)
    for i in range(400):
        g = (gradient if i < 200 else forgetful)(theta)
        watch(theta, g)
        mean, square = 0.9 * mean + 0.1 * g, 0.99 * square + 0.01 * g * g
        theta = theta - 1e-4 * mean / (1 - 0.9 ** (i + 1)) / (np.sqrt(square / (1 - 0.99 ** (i + 1))) + 1e-12)
    print(watch)
    watch.draw("gradient.png")
