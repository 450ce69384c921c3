/* What the filter is compared with: for every cell, every measurement's row of a table of log
 * likelihoods is found by range and direction and added to the cell's belief.
 *
 * One thread does a block of cells. With 4 rows the table is interpolated linearly, with 1 the
 * nearest row is taken. A row is a window of a curve over twice the circle. */
#include <math.h>
#include <string.h>

#define TURN 6.283185307179586

void gather(int cells, const double *cell_x, const double *cell_y, int measurements,
            const double *sensor_x, const double *sensor_y, const double *right,
            const double *width, const int *label, double min_range, double max_range,
            const float *restrict table, int ranges, double range_step, int classes, int bins,
            const float *background, float *restrict belief, float *restrict nothing, int rows) {
    const long row = (long)classes * 2 * bins;
#pragma omp parallel for schedule(dynamic, 16)
    for (int c = 0; c < cells; c++) {
        float *restrict out = belief + (long)c * classes * bins;
        memset(out, 0, sizeof(float) * classes * bins);
        nothing[c] = 0;
        for (int m = 0; m < measurements; m++) {
            const double x = sensor_x[m] - cell_x[c], y = sensor_y[m] - cell_y[c];
            const double range = sqrt(x * x + y * y);
            const double direction = atan2f((float)y, (float)x);
            double from_right = direction + TURN / 2 - right[m];
            from_right -= TURN * floor(from_right / TURN);
            if (from_right > width[m] || range < min_range || range > max_range) continue;
            nothing[c] += background[label[m]];
            const double r = range / range_step, d = direction * bins / TURN;
            if (rows == 1) {
                const int i = (int)(r + 0.5), j = ((int)lrint(d) + bins) % bins;
                const float *near = table + ((long)label[m] * ranges + i) * row + bins - j;
                for (int k = 0; k < classes; k++)
                    for (int b = 0; b < bins; b++) out[k * bins + b] += near[k * 2 * bins + b];
            } else {
                const int i = (int)r, below = (int)floor(d), j = (below + bins) % bins;
                const float s = r - i, t = d - below;
                const float *low = table + ((long)label[m] * ranges + i) * row + bins - j;
                const float *high = low + row;
                const float a = (1 - s) * (1 - t), e = (1 - s) * t, f = s * (1 - t), g = s * t;
                for (int k = 0; k < classes; k++)
                    for (int b = 0; b < bins; b++) {
                        const long at = k * 2 * bins + b;
                        out[k * bins + b] +=
                            a * low[at] + e * low[at - 1] + f * high[at] + g * high[at - 1];
                    }
            }
        }
    }
}
