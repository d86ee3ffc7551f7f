// Levenberg-Marquardt of eq. 5 for many exemplars: the camera that best explains 2D joints.
// app/lifting/resection.py says what the arrays are and calls this.
//
// Every exemplar is solved alone, so that its camera does not depend on the others in the call.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "translation.hpp"

namespace {

using posematch::Nearest;

constexpr double kInitialDamping = 1e-4;
// Radians against millimetres: a radian moves a joint by about a metre.
constexpr double kUnitBalance[6] = {1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6};

struct Camera {
    double rotation[9], translation[3];
};

// One exemplar before one observation; `points` (J, 3), `targets` (J, 2), `weights` (J,).
class Problem {
   public:
    Problem(int64_t n, const double* points, const double* targets, const double* weights,
            Nearest nearest)
        : n_(n), points_(points), targets_(targets), weights_(weights), nearest_(nearest) {}

    // Place the exemplar by a camera: joints (J, 3) in its frame, and residuals (J, 2). Returns
    // whether the root is as far away as it has to be.
    bool place(const Camera& camera, double* placed, double* residuals) const {
        const double* t = camera.translation;
        double forward = 0.0;
        posematch::turn(n_, camera.rotation, points_, placed);
        for (int64_t j = 0; j < n_; ++j) {
            double* q = placed + 3 * j;
            forward = std::min(forward, q[2]);
            for (int i = 0; i < 3; ++i) q[i] += t[i];
            residuals[2 * j] = q[0] / q[2] - targets_[2 * j];
            residuals[2 * j + 1] = q[1] / q[2] - targets_[2 * j + 1];
        }
        return t[2] >= nearest_.depth(forward);
    }

    double cost(const double* residuals) const {
        double sum = 0.0;
        for (int64_t j = 0; j < n_; ++j) {
            const double x = residuals[2 * j], y = residuals[2 * j + 1];
            sum += weights_[j] * (x * x + y * y);
        }
        return sum;
    }

    // Solve (JᵀWJ + λ diag) δ = -JᵀWr, the camera moving as exp([ω]×) R, t + τ with δ = (ω, τ).
    // False where the joints leave a direction undetermined.
    bool step(const Camera& camera, const double* placed, const double* residuals, double damping,
              double* delta) const {
        double normal[6][6] = {}, gradient[6] = {};
        for (int64_t j = 0; j < n_; ++j) {
            const double inverse = 1.0 / placed[3 * j + 2], w = weights_[j];
            const double x = placed[3 * j] * inverse, y = placed[3 * j + 1] * inverse;
            // Of the joint: right, down and forward of the root, over its depth.
            const double a = x - camera.translation[0] * inverse;
            const double b = y - camera.translation[1] * inverse;
            const double c = 1.0 - camera.translation[2] * inverse;
            const double by_x[6] = {-x * b, c + x * a, -b, inverse, 0.0, -x * inverse};
            const double by_y[6] = {-c - y * b, y * a, a, 0.0, inverse, -y * inverse};
            const double rx = residuals[2 * j], ry = residuals[2 * j + 1];
            for (int p = 0; p < 6; ++p) {
                const double wx = w * by_x[p], wy = w * by_y[p];
                for (int q = 0; q <= p; ++q) normal[p][q] += wx * by_x[q] + wy * by_y[q];
                gradient[p] += wx * rx + wy * ry;
            }
        }
        double largest = 0.0;
        for (int p = 0; p < 6; ++p) largest = std::max(largest, normal[p][p]);
        for (int p = 0; p < 6; ++p)
            normal[p][p] =
                normal[p][p] * (1.0 + damping) + 1e-12 * largest * kUnitBalance[p] + 1e-300;
        return solve(normal, gradient, delta);
    }

   private:
    // Cholesky, in place: normal (its lower half) δ = -gradient.
    static bool solve(double (&normal)[6][6], const double* gradient, double* delta) {
        for (int p = 0; p < 6; ++p) {
            for (int q = 0; q <= p; ++q) {
                double sum = normal[p][q];
                for (int k = 0; k < q; ++k) sum -= normal[p][k] * normal[q][k];
                if (p != q) {
                    normal[p][q] = sum / normal[q][q];
                } else if (sum > 0.0) {
                    normal[p][p] = std::sqrt(sum);
                } else {
                    return false;
                }
            }
        }
        for (int p = 0; p < 6; ++p) {
            double sum = -gradient[p];
            for (int k = 0; k < p; ++k) sum -= normal[p][k] * delta[k];
            delta[p] = sum / normal[p][p];
        }
        for (int p = 5; p >= 0; --p) {
            for (int k = p + 1; k < 6; ++k) delta[p] -= normal[k][p] * delta[k];
            delta[p] /= normal[p][p];
        }
        return true;
    }

    const int64_t n_;
    const double *points_, *targets_, *weights_;
    const Nearest nearest_;
};

// exp([ω]×) R and t + τ. Rodrigues' formula by the half angle: exact also where it vanishes.
Camera moved(const Camera& camera, const double* delta) {
    const double x = delta[0], y = delta[1], z = delta[2];
    const double squared = x * x + y * y + z * z;
    const double half = std::max(0.5 * std::sqrt(squared), 1e-8);
    const double sinc = std::sin(half) / half;
    const double first = sinc * std::cos(half), second = 0.5 * sinc * sinc;
    const double level = 1.0 - second * squared;
    const double turn[9] = {
        level + second * x * x, second * x * y - first * z, second * x * z + first * y,
        second * x * y + first * z, level + second * y * y, second * y * z - first * x,
        second * x * z - first * y, second * y * z + first * x, level + second * z * z};
    Camera result;
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) {
            double sum = 0.0;
            for (int k = 0; k < 3; ++k) sum += turn[3 * i + k] * camera.rotation[3 * k + j];
            result.rotation[3 * i + j] = sum;
        }
        result.translation[i] = camera.translation[i] + delta[3 + i];
    }
    return result;
}

}  // namespace

// Cameras, `rotation` (B, 3, 3) and `translation` (B, 3), of exemplars (B, J, 3) from rotations
// (B, 3, 3), where the search starts; the exemplars placed by them and the residuals (B, J, 2).
// `targets` (B, J, 2) and `weights` (B, J), or one of each for all.
extern "C" void posematch_resect(int64_t batch, int64_t n_joints, const double* points,
                                 const double* start, const double* targets, const double* weights,
                                 int shared, int64_t iterations, double nearest_to_extent,
                                 double least_extent, double* rotation, double* translation,
                                 double* placed, double* residuals) {
    const Nearest nearest = {nearest_to_extent, least_extent};
    std::vector<posematch::Translation> first;
    std::vector<double> new_placed(3 * n_joints), new_residuals(2 * n_joints);
    for (int64_t b = 0; b < batch; ++b) {
        const int64_t at = shared ? 0 : b * n_joints;
        const double* exemplar = points + 3 * b * n_joints;
        double *now = placed + 3 * b * n_joints, *off = residuals + 2 * b * n_joints;
        if (b == 0 || !shared)
            first.assign(1, {n_joints, targets + 2 * at, weights + at, nearest});
        const Problem problem(n_joints, exemplar, targets + 2 * at, weights + at, nearest);
        Camera camera;
        std::copy_n(start + 9 * b, 9, camera.rotation);
        posematch::turn(n_joints, camera.rotation, exemplar, now);
        first[0].of(now, camera.translation);
        problem.place(camera, now, off);
        double damping = kInitialDamping;
        for (int64_t i = 0; i < iterations; ++i) {
            double delta[6];
            bool better = problem.step(camera, now, off, damping, delta);
            if (better) {
                const Camera next = moved(camera, delta);
                better = problem.place(next, new_placed.data(), new_residuals.data()) &&
                         problem.cost(new_residuals.data()) <= problem.cost(off);
                if (better) {
                    camera = next;
                    std::copy(new_placed.begin(), new_placed.end(), now);
                    std::copy(new_residuals.begin(), new_residuals.end(), off);
                }
            }
            damping *= better ? 0.1 : 10.0;
        }
        std::copy_n(camera.rotation, 9, rotation + 9 * b);
        std::copy_n(camera.translation, 3, translation + 3 * b);
    }
}
