// The neighbours of a person moved in front of the camera, and their Gaussian.
// app/lifting/ensemble.py says what the arrays are and calls this.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "translation.hpp"
#include "wide.hpp"

namespace {

// Inverse of a symmetric, positive definite matrix (n, n), in place, by Gauss-Jordan.
void invert(std::vector<double>& matrix, int64_t n) {
    for (int64_t p = 0; p < n; ++p) {
        const double pivot = 1.0 / matrix[p * n + p];
        matrix[p * n + p] = 1.0;
        for (int64_t q = 0; q < n; ++q) matrix[p * n + q] *= pivot;
        for (int64_t r = 0; r < n; ++r) {
            if (r == p) continue;
            const double factor = matrix[r * n + p];
            matrix[r * n + p] = 0.0;
            for (int64_t q = 0; q < n; ++q) matrix[r * n + q] -= factor * matrix[p * n + q];
        }
    }
}

double mean_stature(int64_t n, int64_t n_joints, const double* poses, int64_t n_segments,
                    const double* segments, const double* shares) {
    double total = 0.0;
    for (int64_t s = 0; s < n_segments; ++s)
        for (int64_t k = 0; k < n; ++k) {
            double length[3] = {};
            for (int64_t j = 0; j < n_joints; ++j) {
                const double share = segments[s * n_joints + j];
                if (share == 0.0) continue;
                const double* joint = poses + 3 * (k * n_joints + j);
                for (int i = 0; i < 3; ++i) length[i] += share * joint[i];
            }
            total += shares[s] * std::sqrt(length[0] * length[0] + length[1] * length[1] +
                                           length[2] * length[2]);
        }
    return total / n;
}

}  // namespace

// States (n + 1 + D, 3 J) and root depths (n + 1 + D,) of n exemplars (n, J, 3) with rotations
// (n, 3, 3); of the mean of the first `n_typical`; and of that mean changed along each of D
// directions (D, J, J). Also the exemplars' mean stature, a sum of segments (S, J), times joints, in
// `shares` (S,). Returns the standard pixels in a normalised unit.
extern "C" double posematch_place(int64_t n, int64_t n_joints, const double* exemplars,
                                  const double* rotations, const double* points,
                                  const double* weights, int64_t n_typical, int64_t n_directions,
                                  const double* directions, int64_t right_hip, int64_t left_hip,
                                  double nearest_to_extent, double least_extent, double px_per_mm,
                                  int64_t n_segments, const double* segments,
                                  const double* shares, double* stature, double* states,
                                  double* root_depth) {
    const posematch::Translation translation(n_joints, points, weights,
                                             {nearest_to_extent, least_extent});
    const int64_t size = 3 * n_joints, all = n + 1 + n_directions;
    std::vector<double> posed(all * size);
    double* typical = &posed[n * size];
    for (int64_t k = 0; k < n; ++k) {
        double* pose = &posed[k * size];
        posematch::turn(n_joints, rotations + 9 * k, exemplars + k * size, pose);
        if (k < n_typical)
            for (int64_t i = 0; i < size; ++i) typical[i] += pose[i];
    }
    for (int64_t i = 0; i < size; ++i) typical[i] /= std::min(n, n_typical);
    for (int64_t d = 0; d < n_directions; ++d) {
        double* shaped = &posed[(n + 1 + d) * size];
        std::copy_n(typical, size, shaped);
        for (int64_t j = 0; j < n_joints; ++j)
            for (int64_t k = 0; k < n_joints; ++k) {
                const double share = directions[(d * n_joints + j) * n_joints + k];
                for (int i = 0; i < 3; ++i) shaped[3 * j + i] += share * typical[3 * k + i];
            }
    }
    for (int64_t k = 0; k < all; ++k) {
        double* pose = &posed[k * size];
        double shift[3];
        translation.of(pose, shift);
        for (int64_t j = 0; j < n_joints; ++j)
            for (int i = 0; i < 3; ++i) pose[3 * j + i] += shift[i];
        root_depth[k] = 0.5 * (pose[3 * right_hip + 2] + pose[3 * left_hip + 2]);
    }
    std::vector<double> depths(root_depth, root_depth + n);
    std::nth_element(depths.begin(), depths.begin() + n / 2, depths.end());
    const double px_per_unit = px_per_mm * depths[n / 2];
    *stature = mean_stature(n, n_joints, exemplars, n_segments, segments, shares);
    for (int64_t k = 0; k < all; ++k) {
        const double* pose = &posed[k * size];
        double* state = states + k * size;
        for (int64_t j = 0; j < n_joints; ++j, pose += 3) {
            const double scale = px_per_unit / pose[2];
            state[2 * j] = pose[0] * scale;
            state[2 * j + 1] = pose[1] * scale;
            state[2 * n_joints + j] = pose[2] / root_depth[k] - 1.0;
        }
    }
    return px_per_unit;
}

// Weights (n,), mean (S,) and covariance (S, S) of states (n, S) about an observation at `rows`.
// `proportions` (D, S); `factors` (S, S) what covariances are multiplied by.
extern "C" WIDE void posematch_local_prior(
    int64_t n, int64_t size, const double* states, int64_t n_rows, const int64_t* rows,
    const double* observed, int64_t n_proportions, const double* proportions, double bandwidth,
    double adaptive, const double* factors, double* weights, double* mean, double* covariance) {
    // Woodbury: the distance in the metric of bandwidth² I + Gᵀ G.
    const int64_t d = n_proportions;
    std::vector<double> explained(n_rows * d), inner(d * d), reach(d);
    for (int64_t r = 0; r < n_rows; ++r)
        for (int64_t p = 0; p < d; ++p)
            explained[r * d + p] = proportions[p * size + rows[r]] / bandwidth;
    for (int64_t p = 0; p < d; ++p)
        for (int64_t q = 0; q < d; ++q) {
            double sum = p == q ? 1.0 : 0.0;
            for (int64_t r = 0; r < n_rows; ++r)
                sum += explained[r * d + p] * explained[r * d + q];
            inner[p * d + q] = sum;
        }
    invert(inner, d);
    for (int64_t k = 0; k < n; ++k) {
        double squared = 0.0;
        std::fill(reach.begin(), reach.end(), 0.0);
        for (int64_t r = 0; r < n_rows; ++r) {
            const double residual = states[k * size + rows[r]] - observed[rows[r]];
            squared += residual * residual;
            for (int64_t p = 0; p < d; ++p) reach[p] += explained[r * d + p] * residual;
        }
        for (int64_t p = 0; p < d; ++p)
            for (int64_t q = 0; q < d; ++q) squared -= reach[p] * inner[p * d + q] * reach[q];
        weights[k] = squared;
    }
    const double least = *std::min_element(weights, weights + n);
    // Per coordinate; two coordinates a joint less the translation and scale already fitted.
    const double nearest = least / std::max<int64_t>(n_rows - 4, 1);
    const double variance = bandwidth * bandwidth + adaptive * nearest;
    double total = 0.0;
    for (int64_t k = 0; k < n; ++k) {
        weights[k] = std::exp(-0.5 * (weights[k] - least) / variance);
        total += weights[k];
    }
    std::fill_n(mean, size, 0.0);
    for (int64_t k = 0; k < n; ++k) {
        weights[k] /= total;
        for (int64_t i = 0; i < size; ++i) mean[i] += weights[k] * states[k * size + i];
    }
    std::fill_n(covariance, size * size, 0.0);
    // Four states at once, so that sums are fetched and put back a quarter as often.
    std::vector<double> anomalies(4 * size);
    const double *first = &anomalies[0], *second = first + size, *third = second + size,
                 *fourth = third + size;
    for (int64_t k = 0; k < n; k += 4) {
        double share[4] = {};
        for (int64_t m = 0; m < std::min<int64_t>(4, n - k); ++m) {
            share[m] = weights[k + m];
            for (int64_t i = 0; i < size; ++i)
                anomalies[m * size + i] = states[(k + m) * size + i] - mean[i];
        }
        for (int64_t i = 0; i < size; ++i) {
            const double one = share[0] * first[i], two = share[1] * second[i];
            const double three = share[2] * third[i], four = share[3] * fourth[i];
            double* __restrict row = covariance + i * size;
            for (int64_t j = 0; j <= i; ++j)
                row[j] += (one * first[j] + two * second[j]) + (three * third[j] + four * fourth[j]);
        }
    }
    for (int64_t i = 0; i < size; ++i)
        for (int64_t j = 0; j <= i; ++j) {
            double sum = factors[i * size + j] * covariance[i * size + j];
            for (int64_t p = 0; p < d; ++p)
                sum += proportions[p * size + i] * proportions[p * size + j];
            covariance[i * size + j] = covariance[j * size + i] = sum;
        }
}
