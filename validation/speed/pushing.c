/* Costs and gradients of `pushing` under the penalty spring with semi-implicit Euler steps, fused, with its adjoint.
 *
 * theta (T), w (T, B), cost (B), gradient (T, B), in double precision. Columns are taken LANES at a time, so that the
 * states of all steps stay in cache and the loops over lanes vectorise. B must be a multiple of LANES.
 */
#include <stddef.h>

#define LANES 32
#define MOST_STEPS 1024

typedef struct {
    double dt, mass, factor, speed, sigma, stiffness;
} parameters;

static double kept[MOST_STEPS + 1][4][LANES];

static void columns(const parameters *p, size_t T, size_t B, const double *theta, const double *w, double *cost,
                    double *gradient) {
    const double h = p->dt, h_over_m = p->dt / p->mass, k = p->stiffness, c = p->factor, s = p->speed;
    double x1[LANES], x2[LANES], v1[LANES], v2[LANES], a1[LANES], a2[LANES], b1[LANES], b2[LANES], f[LANES];
    for (size_t i = 0; i < LANES; i++) {
        x1[i] = 0.0, x2[i] = 1.0, v1[i] = s, v2[i] = 0.0, f[i] = 0.0;
    }
    for (size_t t = 0; t < T; t++) {
        for (size_t i = 0; i < LANES; i++) {
            const double u = theta[t] + p->sigma * w[t * B + i];
            kept[t][0][i] = x1[i], kept[t][1][i] = x2[i], kept[t][2][i] = v1[i], kept[t][3][i] = v2[i];
            f[i] += 0.1 * (x1[i] - 1.0) * (x1[i] - 1.0) + 10.0 * (x2[i] - 2.0) * (x2[i] - 2.0) +
                    0.1 * (v1[i] - s) * (v1[i] - s) + 0.1 * v2[i] * v2[i] + u * u;
            const double gap = x2[i] - x1[i] - 1.0, force = gap < 0.0 ? -k * gap : 0.0;
            v1[i] = c * v1[i] + h_over_m * (u - force);
            v2[i] = c * v2[i] + h_over_m * force;
            x1[i] += h * v1[i];
            x2[i] += h * v2[i];
        }
    }
    for (size_t i = 0; i < LANES; i++) {
        cost[i] = f[i] + 0.1 * (x1[i] - 1.0) * (x1[i] - 1.0) + 10.0 * (x2[i] - 2.0) * (x2[i] - 2.0) +
                  0.1 * (v1[i] - s) * (v1[i] - s) + 0.1 * v2[i] * v2[i];
        a1[i] = 0.2 * (x1[i] - 1.0), a2[i] = 20.0 * (x2[i] - 2.0), b1[i] = 0.2 * (v1[i] - s), b2[i] = 0.2 * v2[i];
    }
    for (size_t t = T; t-- > 0;) {
        for (size_t i = 0; i < LANES; i++) {
            const double y1 = kept[t][0][i], y2 = kept[t][1][i], r1 = kept[t][2][i], r2 = kept[t][3][i];
            const double u = theta[t] + p->sigma * w[t * B + i];
            const double d1 = b1[i] + h * a1[i], d2 = b2[i] + h * a2[i];
            const double pull = y2 - y1 - 1.0 < 0.0 ? k * h_over_m * (d1 - d2) : 0.0;
            gradient[t * B + i] = h_over_m * d1 + 2.0 * u;
            a1[i] += 0.2 * (y1 - 1.0) - pull;
            a2[i] += 20.0 * (y2 - 2.0) + pull;
            b1[i] = c * d1 + 0.2 * (r1 - s);
            b2[i] = c * d2 + 0.2 * r2;
        }
    }
}

int pushing(const parameters *p, size_t T, size_t B, const double *theta, const double *w, double *cost,
            double *gradient) {
    if (B % LANES != 0 || T > MOST_STEPS) return 1;
    for (size_t start = 0; start < B; start += LANES)
        columns(p, T, B, theta, w + start, cost + start, gradient + start);
    return 0;
}
