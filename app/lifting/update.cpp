// What is observed of a person's state after their joints, and what the state says of the person.
// app/lifting/update.py says what the arrays are and calls this.
//
// Sums run over whole rows at a time, so that several numbers are worked on at once.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "wide.hpp"

namespace {

// The joints (J, 3) mm of a state whose root is so deep.
void joints_of(int64_t n_joints, const double* state, double px_per_unit, double root_depth,
               double* joints) {
    for (int64_t j = 0; j < n_joints; ++j) {
        const double depth = root_depth * (1.0 + state[2 * n_joints + j]);
        joints[3 * j] = state[2 * j] / px_per_unit * depth;
        joints[3 * j + 1] = state[2 * j + 1] / px_per_unit * depth;
        joints[3 * j + 2] = depth;
    }
}

// Solves A X = B for symmetric, positive definite A (n, n) and B (n, columns), both in place;
// pivots below `least` count as that.
WIDE void solve(int64_t n, double* a, int64_t columns, double* b, double least) {
    for (int64_t p = 0; p < n; ++p) {
        const double pivot = 1.0 / std::max(a[p * n + p], least);
        for (int64_t q = p + 1; q < n; ++q) {
            const double factor = a[p * n + q] * pivot;
            for (int64_t r = q; r < n; ++r) a[q * n + r] -= factor * a[p * n + r];
            for (int64_t c = 0; c < columns; ++c) b[q * columns + c] -= factor * b[p * columns + c];
        }
    }
    for (int64_t p = n - 1; p >= 0; --p) {
        for (int64_t q = p + 1; q < n; ++q)
            for (int64_t c = 0; c < columns; ++c)
                b[p * columns + c] -= a[p * n + q] * b[q * columns + c];
        const double pivot = 1.0 / std::max(a[p * n + p], least);
        for (int64_t c = 0; c < columns; ++c) b[p * columns + c] *= pivot;
    }
}

// Takes Gᵀ F from a symmetric matrix (n, n), of G and F (rows, n).
WIDE void take(int64_t n, int64_t rows, const double* g, const double* f, double* matrix) {
    for (int64_t k = 0; k < rows; ++k)
        for (int64_t i = 0; i < n; ++i) {
            const double factor = g[k * n + i];
            double* __restrict row = matrix + i * n;
            for (int64_t j = 0; j <= i; ++j) row[j] -= factor * f[k * n + j];
        }
    for (int64_t i = 0; i < n; ++i)
        for (int64_t j = 0; j < i; ++j) matrix[j * n + i] = matrix[i * n + j];
}

}  // namespace

// A state's mean (n,) and covariance P (n, n) after all of it was `seen` (n,) with errors of
// covariance R (n, n), weighed as `doubt` R + diag(`settled`) and left as `errors` R; in place.
extern "C" WIDE void posematch_observe_state(int64_t n, double* mean, double* covariance,
                                             const double* seen, const double* error,
                                             const double* settled, double doubt, double errors) {
    std::vector<double> total(n * n), gain(covariance, covariance + n * n), reach(n * n);
    for (int64_t i = 0; i < n; ++i) {
        for (int64_t j = 0; j < n; ++j)
            total[i * n + j] = covariance[i * n + j] + doubt * error[i * n + j];
        total[i * n + i] += settled[i];
    }
    // Of the gain K, what is solved for is the transpose.
    solve(n, &total[0], n, &gain[0], *std::min_element(settled, settled + n));
    std::vector<double> innovation(n);
    for (int64_t k = 0; k < n; ++k) innovation[k] = seen[k] - mean[k];
    for (int64_t k = 0; k < n; ++k)
        for (int64_t i = 0; i < n; ++i) mean[i] += gain[k * n + i] * innovation[k];
    // P - K (P - (errors - doubt) R Kᵀ)
    for (int64_t i = 0; i < n; ++i)
        for (int64_t j = 0; j < n; ++j) {
            const double factor = (errors - doubt) * error[i * n + j];
            for (int64_t k = 0; k < n; ++k) reach[i * n + k] += factor * gain[j * n + k];
        }
    for (int64_t i = 0; i < n * n; ++i) reach[i] = covariance[i] - reach[i];
    take(n, n, &gain[0], &reach[0], covariance);
}

// The same after m numbers of it were observed, whose `innovation` (m,) has this mean `precision`
// (m, m); `reach` (m, n) is their covariance with the state. In place.
extern "C" WIDE void posematch_observe_joints(int64_t n, int64_t m, double* mean,
                                              double* covariance, const double* reach,
                                              const double* precision, const double* innovation) {
    std::vector<double> gain(m * n);
    for (int64_t a = 0; a < m; ++a)
        for (int64_t b = 0; b < m; ++b)
            for (int64_t i = 0; i < n; ++i)
                gain[a * n + i] += precision[a * m + b] * reach[b * n + i];
    for (int64_t a = 0; a < m; ++a)
        for (int64_t i = 0; i < n; ++i) mean[i] += gain[a * n + i] * innovation[a];
    take(n, m, &gain[0], reach, covariance);
}

// The same after it was observed that the segments (start, end) of each of so many pairs (2, 2)
// are equally long, but for `sigma` of their log ratio; in place.
extern "C" WIDE void posematch_observe_pairs(int64_t n_joints, double* mean, double* covariance,
                                             double px_per_unit, double root_depth,
                                             int64_t n_pairs, const int64_t* pairs, double sigma) {
    const int64_t n = 3 * n_joints, x_y = 2 * n_joints;
    std::vector<double> joints(n), slope(n_pairs * n), reach(n_pairs * n), ratio(n_pairs);
    joints_of(n_joints, mean, px_per_unit, root_depth, &joints[0]);
    for (int64_t p = 0; p < n_pairs; ++p)
        for (int side = 0; side < 2; ++side) {
            const int64_t start = pairs[4 * p + 2 * side], end = pairs[4 * p + 2 * side + 1];
            const double sign = side ? -1.0 : 1.0;
            double segment[3], squared = 0.0;
            for (int i = 0; i < 3; ++i) {
                segment[i] = joints[3 * end + i] - joints[3 * start + i];
                squared += segment[i] * segment[i];
            }
            squared = std::max(squared, 1.0);
            ratio[p] += sign * 0.5 * std::log(squared);
            // By the joints, and on to the state: X = (p z, z) with z = z_root (1 + depth).
            for (const auto& [joint, way] : {std::pair(end, sign), std::pair(start, -sign)}) {
                const double* at = &joints[3 * joint];
                double along = segment[2];
                for (int i = 0; i < 2; ++i) {
                    slope[p * n + 2 * joint + i] +=
                        way * segment[i] / squared * at[2] / px_per_unit;
                    along += segment[i] * at[i] / at[2];
                }
                slope[p * n + x_y + joint] += way * along / squared * root_depth;
            }
        }
    for (int64_t p = 0; p < n_pairs; ++p)
        for (int64_t i = 0; i < n; ++i)
            if (slope[p * n + i] != 0.0)
                for (int64_t j = 0; j < n; ++j)
                    reach[p * n + j] += slope[p * n + i] * covariance[i * n + j];
    std::vector<double> total(n_pairs * n_pairs), gain(reach);
    for (int64_t p = 0; p < n_pairs; ++p)
        for (int64_t q = 0; q < n_pairs; ++q) {
            double sum = p == q ? sigma * sigma : 0.0;
            for (int64_t i = 0; i < n; ++i) sum += slope[p * n + i] * reach[q * n + i];
            total[p * n_pairs + q] = sum;
        }
    solve(n_pairs, &total[0], n, &gain[0], 1e-300);
    for (int64_t p = 0; p < n_pairs; ++p)
        for (int64_t i = 0; i < n; ++i) mean[i] -= gain[p * n + i] * ratio[p];
    take(n, n_pairs, &gain[0], &reach[0], covariance);
}

// What a state says of a person `stature` tall: joints (J, 3) mm; how far they may be from where
// they are about the root, (J,) mm; and how much deeper the far end of each of so many limb
// segments (start, end) is than its near end, and its standard deviation, (limbs, 2) mm. The
// stature expected is the sum of segments (S, J), times joints, in `shares` (S,). Returns the
// depth of the root.
extern "C" double posematch_answer(int64_t n_joints, const double* mean, const double* covariance,
                                   double px_per_unit, double root_depth, double stature,
                                   int64_t n_segments, const double* segments,
                                   const double* shares, int64_t right_hip, int64_t left_hip,
                                   double px_per_mm, int64_t n_limbs, const int64_t* limbs,
                                   double* joints, double* spread, double* along) {
    const int64_t n = 3 * n_joints, depths = 2 * n_joints;
    const auto variance = [&](int64_t i, int64_t j) { return covariance[i * n + j]; };
    joints_of(n_joints, mean, px_per_unit, root_depth, joints);
    double expected = 0.0;
    for (int64_t s = 0; s < n_segments; ++s) {
        const double* row = segments + s * n_joints;
        double squared = 0.0, image = 0.0, deep = 0.0;
        for (int i = 0; i < 3; ++i) {
            double length = 0.0;
            for (int64_t j = 0; j < n_joints; ++j) length += row[j] * joints[3 * j + i];
            squared += length * length;
        }
        for (int64_t j = 0; j < n_joints; ++j) {
            if (row[j] == 0.0) continue;
            for (int64_t k = 0; k < n_joints; ++k) {
                const double share = row[j] * row[k];
                image += share * (variance(2 * j, 2 * k) + variance(2 * j + 1, 2 * k + 1));
                deep += share * variance(depths + j, depths + k);
            }
        }
        const double lacks = image / (px_per_unit * px_per_unit) + deep;
        squared += std::max(lacks * root_depth * root_depth, 0.0);
        expected += shares[s] * std::sqrt(squared);
    }
    // At another distance no image or direction changes.
    const double factor = stature / expected;
    root_depth *= factor;
    for (int64_t i = 0; i < n; ++i) joints[i] *= factor;
    const auto apart = [&](int64_t i, int64_t j) {
        return variance(depths + i, depths + i) - variance(depths + i, depths + j) -
               variance(depths + j, depths + i) + variance(depths + j, depths + j);
    };
    const double hips = 0.25 * apart(right_hip, left_hip);
    for (int64_t j = 0; j < n_joints; ++j) {
        const double deep = 0.5 * (apart(j, right_hip) + apart(j, left_hip)) - hips;
        const double image = variance(2 * j, 2 * j) + variance(2 * j + 1, 2 * j + 1);
        spread[j] = std::sqrt(std::max(
            deep * root_depth * root_depth + image / (px_per_mm * px_per_mm), 0.0));
    }
    for (int64_t l = 0; l < n_limbs; ++l) {
        const int64_t start = limbs[2 * l], end = limbs[2 * l + 1];
        along[2 * l] = joints[3 * end + 2] - joints[3 * start + 2];
        along[2 * l + 1] = root_depth * std::sqrt(std::max(apart(end, start), 0.0));
    }
    return root_depth;
}
