// The scan of a library's index: which rows of the cells nearest to a query are nearest to it.
// library_store/scan.py says what the tables are and calls this.
//
// Sixteen rows lie side by side, number by number: (blocks, 28, 16) bytes. One instruction does the
// same for several rows then, no sum runs across them, and joints of no weight are never read.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#if defined(__x86_64__) && defined(__GNUC__)
#include <immintrin.h>
#define HAVE_AVX2 1
#endif

namespace {

constexpr int kJoints = 14, kLanes = 16;
constexpr int64_t kBlockBytes = 2 * kJoints * kLanes;
constexpr float kLeastSpread = 1e-3f;  // in squared steps: of joints that all but coincide
constexpr int kRun = 64;     // blocks ranked at once, whose similarities the first-level cache holds
constexpr int kBins = 4096;  // of distance, to find out how far the cells reach that are wanted

struct Joint {
    int64_t offset;  // of its x in a block; y lies behind it
    float load_x, load_y, share;
};

using Correlate = void (*)(const int8_t*, int64_t, const Joint*, int, float*);

// The weighted correlation of a query with n blocks of rows: n * 16 numbers, at most 1.
void correlate_anywhere(const int8_t* block, int64_t n, const Joint* joints, int n_joints,
                        float* __restrict out) {
    for (int64_t b = 0; b < n; ++b, block += kBlockBytes, out += kLanes) {
        float product[kLanes] = {}, mean_x[kLanes] = {}, mean_y[kLanes] = {}, square[kLanes] = {};
        for (const Joint* joint = joints; joint < joints + n_joints; ++joint) {
            const int8_t* at = block + joint->offset;
            for (int i = 0; i < kLanes; ++i) {
                const float x = at[i], y = at[kLanes + i];
                const float share_x = joint->share * x, share_y = joint->share * y;
                product[i] += joint->load_x * x + joint->load_y * y;
                mean_x[i] += share_x;
                mean_y[i] += share_y;
                square[i] += share_x * x + share_y * y;
            }
        }
        for (int i = 0; i < kLanes; ++i) {
            const float spread = square[i] - mean_x[i] * mean_x[i] - mean_y[i] * mean_y[i];
            out[i] = product[i] / std::sqrt(std::max(spread, kLeastSpread));
        }
    }
}

#ifdef HAVE_AVX2
__attribute__((target("avx2,fma"))) inline __m256 eight(const int8_t* at) {
    const __m128i bytes = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(at));
    return _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(bytes));
}

// The same, three to ten times as fast.
__attribute__((target("avx2,fma"))) void correlate_avx2(const int8_t* block, int64_t n,
                                                        const Joint* joints, int n_joints,
                                                        float* out) {
    for (int64_t half = 0; half < 2 * n; ++half, out += kLanes / 2) {
        const int8_t* rows = block + half / 2 * kBlockBytes + half % 2 * (kLanes / 2);
        __m256 product_x = _mm256_setzero_ps(), product_y = product_x, mean_x = product_x,
               mean_y = product_x, square_x = product_x, square_y = product_x;
        for (const Joint* joint = joints; joint < joints + n_joints; ++joint) {
            const __m256 x = eight(rows + joint->offset), y = eight(rows + joint->offset + kLanes);
            const __m256 share = _mm256_set1_ps(joint->share);
            const __m256 share_x = _mm256_mul_ps(share, x), share_y = _mm256_mul_ps(share, y);
            product_x = _mm256_fmadd_ps(_mm256_set1_ps(joint->load_x), x, product_x);
            product_y = _mm256_fmadd_ps(_mm256_set1_ps(joint->load_y), y, product_y);
            mean_x = _mm256_add_ps(mean_x, share_x);
            mean_y = _mm256_add_ps(mean_y, share_y);
            square_x = _mm256_fmadd_ps(share_x, x, square_x);
            square_y = _mm256_fmadd_ps(share_y, y, square_y);
        }
        __m256 spread = _mm256_add_ps(square_x, square_y);
        spread = _mm256_fnmadd_ps(mean_x, mean_x, spread);
        spread = _mm256_fnmadd_ps(mean_y, mean_y, spread);
        spread = _mm256_sqrt_ps(_mm256_max_ps(spread, _mm256_set1_ps(kLeastSpread)));
        _mm256_storeu_ps(out, _mm256_div_ps(_mm256_add_ps(product_x, product_y), spread));
    }
}
#endif

Correlate fastest() {
#ifdef HAVE_AVX2
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return correlate_avx2;
#endif
    return correlate_anywhere;
}

// The n most similar rows seen so far. Keeps up to four times as many, for sorting out the best of
// many at once is cheaper than keeping order.
class Best {
  public:
    explicit Best(int64_t n) : n_(n), kept_(4 * n) {}

    void offer(const float* similarity, int64_t n_rows, int64_t first) {
        for (int64_t i = 0; i < n_rows; ++i) {
            if (!(similarity[i] > least_)) continue;
            kept_[n_kept_++] = {similarity[i], first + i};
            if (n_kept_ == kept_.size()) sort_out();
        }
    }

    int64_t write(int64_t* rows) {
        if (n_kept_ > n_) sort_out();
        for (size_t i = 0; i < n_kept_; ++i) rows[i] = kept_[i].row;
        return static_cast<int64_t>(n_kept_);
    }

  private:
    struct Row {
        float similarity;
        int64_t row;
    };

    void sort_out() {
        std::nth_element(kept_.begin(), kept_.begin() + (n_ - 1), kept_.begin() + n_kept_,
                         [](const Row& a, const Row& b) { return a.similarity > b.similarity; });
        n_kept_ = n_;
        least_ = kept_[n_ - 1].similarity;
    }

    size_t n_, n_kept_ = 0;
    float least_ = -std::numeric_limits<float>::infinity();
    std::vector<Row> kept_;
};

// Per cell its bin of distance; returns the last bin that is wanted for n_scanned rows.
int reach(const float* similarity, const int64_t* starts, int64_t n_cells, int64_t n_scanned,
          int32_t* bins) {
    for (int64_t c = 0; c < n_cells; ++c) {
        // Finer than in similarity where it is high.
        const float distance = std::sqrt(std::max(0.0f, 0.5f - 0.5f * similarity[c]));
        bins[c] = static_cast<int32_t>(std::min(distance * kBins, kBins - 1.0f));
    }
    std::vector<int64_t> held(kBins);
    for (int64_t c = 0; c < n_cells; ++c) held[bins[c]] += starts[c + 1] - starts[c];
    int last = 0;
    for (int64_t rows = held[0]; rows < n_scanned && last + 1 < kBins;) rows += held[++last];
    return last;
}

struct Run {
    int64_t first, end;  // blocks
};

// Have the memory begin to bring a run: runs lie anywhere, so that it cannot foresee them.
void fetch(const int8_t* codes, const Run& run) {
    constexpr int64_t kLine = 64;
    const int8_t* end = codes + run.end * kBlockBytes;
    for (const int8_t* at = codes + run.first * kBlockBytes; at < end; at += kLine)
        __builtin_prefetch(at);
}

}  // namespace

extern "C" int64_t posematch_scan(const int8_t* codes, int64_t n_rows, const int8_t* centres,
                                  const int64_t* starts, int64_t n_cells, const float* load,
                                  const float* share, int64_t n_scanned, int64_t n_best,
                                  int64_t* best_rows, int portable) {
    const Correlate correlate = portable ? correlate_anywhere : fastest();
    Joint joints[kJoints];
    int n_joints = 0;
    for (int j = 0; j < kJoints; ++j)
        if (share[j] > 0)
            joints[n_joints++] = {2 * j * kLanes, load[2 * j], load[2 * j + 1], share[j]};

    const int64_t centre_blocks = (n_cells + kLanes - 1) / kLanes;
    std::vector<float> near(centre_blocks * kLanes);
    correlate(centres, centre_blocks, joints, n_joints, near.data());
    std::vector<int32_t> bins(n_cells);
    const int last_bin = reach(near.data(), starts, n_cells, n_scanned, bins.data());

    std::vector<Run> runs;
    int64_t done = 0;  // a block may hold the end of one cell and the start of the next
    for (int64_t c = 0; c < n_cells; ++c) {
        if (bins[c] > last_bin || starts[c] == starts[c + 1]) continue;
        const int64_t end = (starts[c + 1] + kLanes - 1) / kLanes;
        for (int64_t block = std::max(done, starts[c] / kLanes); block < end; block += kRun)
            runs.push_back({block, std::min(block + kRun, end)});
        done = std::max(done, end);
    }

    Best best(n_best);
    float similarity[kRun * kLanes];
    for (size_t r = 0; r < runs.size(); ++r) {
        const auto [block, end] = runs[r];
        if (r + 1 < runs.size()) fetch(codes, runs[r + 1]);
        correlate(codes + block * kBlockBytes, end - block, joints, n_joints, similarity);
        const int64_t first = block * kLanes;
        best.offer(similarity, std::min(end * kLanes, n_rows) - first, first);
    }
    return best.write(best_rows);
}
