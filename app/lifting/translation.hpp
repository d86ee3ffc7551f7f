// Where a pose of known orientation stands, by linear least squares.
//
// x (Z + t_z) = X + t_x, and the same for y, is linear in t: scaled projection made exact for
// perspective. Its weighted normal equations are solved in closed form; all that depends on the
// observation alone is worked out once.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

namespace posematch {

// How near the root may come: so many times what the pose reaches forward, at least so many mm.
struct Nearest {
    double to_extent, least_extent;

    double depth(double forward) const { return to_extent * std::max(-forward, least_extent); }
};

class Translation {
   public:
    // `targets` (J, 2) normalised image coordinates; `weights` (J,), not all 0.
    Translation(int64_t n_joints, const double* targets, const double* weights, Nearest nearest)
        : terms_(n_joints), nearest_(nearest) {
        double total = 0.0;
        for (int64_t j = 0; j < n_joints; ++j) total += weights[j];
        for (int64_t j = 0; j < n_joints; ++j) {
            Term& term = terms_[j];
            term.share = weights[j] / total;
            for (int i = 0; i < 2; ++i) {
                term.moment[i] = term.share * targets[2 * j + i];
                mean_[i] += term.moment[i];
            }
        }
        for (int64_t j = 0; j < n_joints; ++j) {
            Term& term = terms_[j];
            for (int i = 0; i < 2; ++i) {
                term.spread[i] = term.moment[i] - term.share * mean_[i];
                term.own += term.spread[i] * targets[2 * j + i];
            }
            own_ += term.own;
        }
    }

    // Of rotated joints (J, 3), about the root: (3,) mm, in front of the camera also when the
    // joints say nothing about depth.
    void of(const double* rotated, double* translation) const {
        // With shift = x Z - X: mean(shift), and the spread's moment with it.
        double mean_shift[2] = {}, moment = 0.0, forward = 0.0;
        for (const Term& term : terms_) {
            const double x = rotated[0], y = rotated[1], z = rotated[2];
            mean_shift[0] += term.moment[0] * z - term.share * x;
            mean_shift[1] += term.moment[1] * z - term.share * y;
            moment += term.own * z - term.spread[0] * x - term.spread[1] * y;
            forward = std::min(forward, z);
            rotated += 3;
        }
        // The first two unknowns eliminated: t_xy = mean(shift) + mean(x) t_z.
        const double depth = std::max(-moment / std::max(own_, 1e-12), nearest_.depth(forward));
        for (int i = 0; i < 2; ++i) translation[i] = mean_shift[i] + mean_[i] * depth;
        translation[2] = depth;
    }

   private:
    struct Term {
        double share = 0.0, moment[2] = {}, spread[2] = {}, own = 0.0;
    };

    std::vector<Term> terms_;
    double mean_[2] = {}, own_ = 0.0;
    Nearest nearest_;
};

// A pose (J, 3) turned by a rotation (3, 3), joint by joint.
inline void turn(int64_t n_joints, const double* rotation, const double* points, double* turned) {
    for (int64_t j = 0; j < n_joints; ++j, points += 3, turned += 3)
        for (int i = 0; i < 3; ++i)
            turned[i] = rotation[3 * i] * points[0] + rotation[3 * i + 1] * points[1] +
                        rotation[3 * i + 2] * points[2];
}

}  // namespace posematch
