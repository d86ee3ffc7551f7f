// How well an innovation is explained at several levels of noise, with all joints and without any
// one of them. app/lifting/evidence.py says what the arrays are and calls this.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "wide.hpp"

namespace {

// Inverse of A = prior + var I (n, n) into `inverse`; returns log det A. By Cholesky's factor,
// whose squared pivots are `var` at least: what rounding takes from them is given back.
WIDE double invert(int64_t n, const double* prior, double var, double* inverse,
              std::vector<double>& factor) {
    double log_determinant = 0.0;
    for (int64_t p = 0; p < n; ++p) {
        double* row = &factor[p * n];
        for (int64_t q = 0; q <= p; ++q) {
            const double* other = &factor[q * n];
            double sum = prior[p * n + q] + (p == q ? var : 0.0);
            for (int64_t k = 0; k < q; ++k) sum -= row[k] * other[k];
            row[q] = p == q ? std::sqrt(std::max(sum, var)) : sum / other[q];
        }
        log_determinant += 2.0 * std::log(row[p]);
    }
    // The factor's own inverse, row by row in place.
    for (int64_t p = 0; p < n; ++p) {
        double* row = &factor[p * n];
        const double pivot = 1.0 / row[p];
        double* sum = inverse;  // n numbers to work with
        std::fill_n(sum, p, 0.0);
        for (int64_t k = 0; k < p; ++k)
            for (int64_t q = 0; q <= k; ++q) sum[q] += row[k] * factor[k * n + q];
        for (int64_t q = 0; q < p; ++q) row[q] = -pivot * sum[q];
        row[p] = pivot;
    }
    std::fill_n(inverse, n * n, 0.0);
    for (int64_t k = 0; k < n; ++k) {
        const double* row = &factor[k * n];
        for (int64_t p = 0; p <= k; ++p)
            for (int64_t q = 0; q <= p; ++q) inverse[p * n + q] += row[p] * row[q];
    }
    for (int64_t p = 0; p < n; ++p)
        for (int64_t q = 0; q < p; ++q) inverse[q * n + p] = inverse[p * n + q];
    return log_determinant;
}

}  // namespace

// Of `prior` (n, n) and `innovation` (n,) at noise variances (L,): the log of each level's share in
// the evidence (L,), what leaving out each joint adds to the log evidence of all levels (n / 2,),
// the joint being anywhere within `elsewhere` instead, and the mean precision (n, n) over the levels.
extern "C" void posematch_evidence(int64_t n, int64_t n_levels, const double* prior,
                                   const double* innovation, const double* noise_var,
                                   double elsewhere, double* log_share, double* odds,
                                   double* mean_precision) {
    std::vector<double> inverses(n_levels * n * n), factor(n * n), pull(n);
    std::vector<double> without(n_levels * (n / 2));
    for (int64_t l = 0; l < n_levels; ++l) {
        double* inverse = &inverses[l * n * n];
        const double log_determinant = invert(n, prior, noise_var[l], inverse, factor);
        double explained = 0.0;
        for (int64_t p = 0; p < n; ++p) {
            pull[p] = 0.0;
            for (int64_t q = 0; q < n; ++q) pull[p] += inverse[p * n + q] * innovation[q];
            explained += pull[p] * innovation[p];
        }
        log_share[l] = -0.5 * (log_determinant + explained);
        for (int64_t j = 0; j < n / 2; ++j) {
            // The joint's block (a, b; b, c) of the precision, and the pull (p, q) on it.
            const double* block = inverse + 2 * j * (n + 1);
            const double a = block[0], b = block[1], c = block[n + 1];
            const double p = pull[2 * j], q = pull[2 * j + 1];
            const double determinant = a * c - b * b;
            // The residual about the prediction by the other joints is the block's inverse times
            // the pull; as an outlier it would have cost a broad Gaussian about that prediction.
            const double x = (c * p - b * q) / determinant, y = (a * q - b * p) / determinant;
            const double outside = (x * x + y * y) / (elsewhere * elsewhere);
            without[l * (n / 2) + j] =
                0.5 * (x * p + y * q - std::log(determinant) - outside) - 2.0 * std::log(elsewhere);
        }
    }
    const double top = *std::max_element(log_share, log_share + n_levels);
    double total = 0.0;
    for (int64_t l = 0; l < n_levels; ++l) total += std::exp(log_share[l] - top);
    std::fill_n(mean_precision, n * n, 0.0);
    for (int64_t l = 0; l < n_levels; ++l) {
        log_share[l] -= top + std::log(total);
        const double share = std::exp(log_share[l]);
        for (int64_t i = 0; i < n * n; ++i) mean_precision[i] += share * inverses[l * n * n + i];
    }
    // Each joint at its own level, relative to the evidence of all joints, whose shares sum to 1.
    for (int64_t j = 0; j < n / 2; ++j) {
        const auto log_of = [&](int64_t l) { return without[l * (n / 2) + j] + log_share[l]; };
        double most = log_of(0), sum = 0.0;
        for (int64_t l = 1; l < n_levels; ++l) most = std::max(most, log_of(l));
        for (int64_t l = 0; l < n_levels; ++l) sum += std::exp(log_of(l) - most);
        odds[j] = std::log(sum) + most;
    }
}
