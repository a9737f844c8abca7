// The limit: an explicit step of linear tetrahedra written by hand for the CPU's vector units.
//
//     g++ -std=c++20 -O3 -march=native -ffast-math -fopenmp limit.cpp -o limit
//     limit MESH MATERIAL VARIANT THREADS STEPS REPEATS FORCES DISPLACEMENTS
//
// MESH is what contenders/limit.py writes: counts, cells, inverse shape matrices, the volumes times the material's two
// parameters (all stresses here are linear in them), inverse masses, displacements, dt. Prints the seconds of each
// repeat of STEPS steps; FORCES and DISPLACEMENTS receive the internal forces at the start and where points end.
//
// Variants:
//   scalar     one cell at a time, corner forces added to the points
//   lanesN     N cells at a time, one in each lane of a vector; points are 16 bytes, so a point is one load or one
//              load-add-store, and vectors are turned from points to components by transposing 4x4 blocks
//   stripsKxN  the same for strips of K cells, each sharing a face with the one before: K + 3 points instead of 4 K
//   sumsN      N cells at a time, corner forces written and summed per point through an index list, without a race
//
// Threads have forces of their own, summed where points move.
// Formulas: warpfem's materials, in the displacement gradient H, which keeps their accuracy near rest.

#include <immintrin.h>
#include <omp.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <map>
#include <numeric>
#include <string>
#include <vector>

namespace {

// --- vectors ---------------------------------------------------------------------------------------------

template <int N>
struct Lanes {
    typedef float Float __attribute__((vector_size(4 * N)));
    typedef int32_t Int __attribute__((vector_size(4 * N)));
};
template <>
struct Lanes<1> {
    using Float = float;
    using Int = int32_t;
};
using Four = Lanes<4>::Float;

inline float largest(float a, float b) { return a > b ? a : b; }
template <typename V>
inline V largest(V a, float b) {
    return a > b ? a : V{} + b;
}
inline float root(float a) { return std::sqrt(a); }
inline Lanes<8>::Float root(Lanes<8>::Float a) { return Lanes<8>::Float(_mm256_sqrt_ps(__m256(a))); }
#ifdef __AVX512F__
inline Lanes<16>::Float root(Lanes<16>::Float a) { return Lanes<16>::Float(_mm512_sqrt_ps(__m512(a))); }
#endif

inline float logarithm_of_ratio(float j) { return std::log1p(j); }

// ln(1 + j) by the exponent and a polynomial of the rest (Moshier, Cephes), from j itself where the exponent is 0
template <typename V>
inline V logarithm_of_ratio(V j) {
    typedef int32_t Int __attribute__((vector_size(sizeof(V))));
    V J = 1.0f + j;
    Int bits = (Int)J - 0x3f3504f3;  // sqrt(1/2)
    Int exponent = bits >> 23;
    V e = __builtin_convertvector(exponent, V);
    V m = (V)((bits & 0x007fffff) + 0x3f3504f3);
    V f = exponent == 0 ? j : m - 1.0f;
    V p = 7.0376836292e-2f + V{};
    p = p * f - 1.1514610310e-1f;
    p = p * f + 1.1676998740e-1f;
    p = p * f - 1.2420140846e-1f;
    p = p * f + 1.4249322787e-1f;
    p = p * f - 1.6668057665e-1f;
    p = p * f + 2.0000714765e-1f;
    p = p * f - 2.4999993993e-1f;
    p = p * f + 3.3333331174e-1f;
    V f2 = f * f;
    V result = f - 0.5f * f2 + f2 * f * p + 0.693147181f * e;
    return J > 0.0f ? result : V{} + NAN;
}

template <typename V>
struct Matrix {
    V a[3][3];
};

template <typename V>
inline Matrix<V> cofactor(const Matrix<V>& F) {
    Matrix<V> C;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
            C.a[i][j] = F.a[i1][j1] * F.a[i2][j2] - F.a[i1][j2] * F.a[i2][j1];
        }
    return C;
}

template <typename V>
inline Matrix<V> with_identity(const Matrix<V>& H) {
    Matrix<V> F = H;
    for (int i = 0; i < 3; i++) F.a[i][i] += 1.0f;
    return F;
}

template <typename V>
inline V dot(const Matrix<V>& A, const Matrix<V>& B) {
    V s = A.a[0][0] * B.a[0][0];
    for (int k = 1; k < 9; k++) s += A.a[k / 3][k % 3] * B.a[k / 3][k % 3];
    return s;
}

template <typename V>
inline Matrix<V> product(const Matrix<V>& A, const Matrix<V>& B) {
    Matrix<V> C;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) C.a[i][j] = A.a[i][0] * B.a[0][j] + A.a[i][1] * B.a[1][j] + A.a[i][2] * B.a[2][j];
    return C;
}

template <typename V>
inline Matrix<V> transposed(const Matrix<V>& A) {
    Matrix<V> T;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) T.a[i][j] = A.a[j][i];
    return T;
}

// cof F - I = (tr H) I - H^T + cof H and J - 1 = tr H + I2(H) + det H
template <typename V>
struct Volume {
    Matrix<V> change;
    V j;
};
template <typename V>
inline Volume<V> volume(const Matrix<V>& H) {
    Matrix<V> C = cofactor(H);
    V trace = H.a[0][0] + H.a[1][1] + H.a[2][2];
    V minors = C.a[0][0] + C.a[1][1] + C.a[2][2];
    V det = H.a[0][0] * C.a[0][0] + H.a[0][1] * C.a[0][1] + H.a[0][2] * C.a[0][2];
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) C.a[i][k] -= H.a[k][i];
    for (int i = 0; i < 3; i++) C.a[i][i] += trace;
    return {C, trace + minors + det};
}

// --- materials: the first Piola-Kirchhoff stress, linear in the parameters a and b ---------------------------

struct StableNeoHookean {  // Smith, de Goes and Kim (2018), with the logarithm in the energy
    template <typename V>
    static Matrix<V> stress(const Matrix<V>& H, V a, V b) {
        auto [change, j] = volume(H);
        V s = 2.0f * (H.a[0][0] + H.a[1][1] + H.a[2][2]) + dot(H, H);
        V softening = a * s / (4.0f * (4.0f + s));
        V shear = 0.75f * a, pressure = b * j;
        V onH = shear + softening, onC = pressure - shear, onI = softening + pressure;
        Matrix<V> P;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) P.a[i][k] = onH * H.a[i][k] + onC * change.a[i][k];
        for (int i = 0; i < 3; i++) P.a[i][i] += onI;
        return P;
    }
};

struct NeoHookean {  // Bonet and Wood (2008): P = (mu (H + H^T + H H^T) + lam ln J I) cof F / J
    template <typename V>
    static Matrix<V> stress(const Matrix<V>& H, V a, V b) {
        auto [change, j] = volume(H);
        V log_j = b * logarithm_of_ratio(j), inverse = 1.0f / (1.0f + j);
        // mu (F - F^-T) = mu (J H + (J - 1) I - (cof F - I)) / J
        V onC = inverse * (log_j - a), onI = inverse * (log_j + a * j);
        Matrix<V> P;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) P.a[i][k] = a * H.a[i][k] + onC * change.a[i][k];
        for (int i = 0; i < 3; i++) P.a[i][i] += onI;
        return P;
    }
};

struct FixedCorotated {  // Stomakhin et al. (2012): P = 2 mu (F - R) + lam (J - 1) cof F
    template <typename V>
    static Matrix<V> stress(const Matrix<V>& H, V a, V b) {
        auto [change, j] = volume(H);
        Matrix<V> F = with_identity(H), C = with_identity(change);
        // The rotation from the trace of the stretch, the largest root of a quartic, by Cayley-Hamilton
        V square_norm = dot(F, F), norm = root(square_norm), inverse_norm = 1.0f / norm;
        V inverse_square = inverse_norm * inverse_norm;
        V J = (1.0f + j) * inverse_square * inverse_norm;
        V c0 = 1.0f - 4.0f * dot(C, C) * inverse_square * inverse_square;
        V i1 = V{} + 1.7320508f;
        for (int iteration = 0; iteration < 5; iteration++) {
            V sq = i1 * i1;
            V value = (sq - 2.0f) * sq - 8.0f * J * i1 + c0;
            i1 -= value / largest(4.0f * i1 * (sq - 1.0f) - 8.0f * J, 1e-6f);
        }
        V i2 = 0.5f * (i1 * i1 - 1.0f);
        V scale = 1.0f / (i1 * i2 - J);
        V onF = (i1 * i1 - i2) * scale * inverse_norm, onC = i1 * scale * inverse_square;
        V onFFF = scale * inverse_square * inverse_norm;
        Matrix<V> G = product(transposed(F), F), FG = product(F, G), R;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++)
                R.a[i][k] = onF * F.a[i][k] + onC * C.a[i][k] - onFFF * FG.a[i][k];
        Matrix<V> Q = product(transposed(R), R);  // one step towards the nearest rotation
        for (auto& row : Q.a)
            for (V& q : row) q *= -0.5f;
        for (int i = 0; i < 3; i++) Q.a[i][i] += 1.5f;
        R = product(R, Q);
        // F - R = R (S + I)^-1 (H + H^T + H^T H)
        Matrix<V> S = product(transposed(R), F), E = product(transposed(H), H);
        Matrix<V> T;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) {
                T.a[i][k] = 0.5f * (S.a[i][k] + S.a[k][i]);
                E.a[i][k] += H.a[i][k] + H.a[k][i];
            }
        for (int i = 0; i < 3; i++) T.a[i][i] += 1.0f;
        Matrix<V> D = cofactor(T);  // symmetric
        V det = T.a[0][0] * D.a[0][0] + T.a[0][1] * D.a[0][1] + T.a[0][2] * D.a[0][2];
        Matrix<V> P = product(R, product(D, E));
        V onP = 2.0f * a / det, pressure = b * j;
        for (int i = 0; i < 3; i++)
            for (int k = 0; k < 3; k++) P.a[i][k] = onP * P.a[i][k] + pressure * C.a[i][k];
        return P;
    }
};

// --- points: 16 bytes each, and vectors of N of them ---------------------------------------------------------

template <int N, typename V = typename Lanes<N>::Float>
inline void load_points(const Four* x, const int32_t* index, V out[3]) {
    if constexpr (N == 1) {
        for (int c = 0; c < 3; c++) out[c] = x[*index][c];
    } else if constexpr (N == 8) {
        __m256 z[4];
        for (int q = 0; q < 4; q++)
            z[q] = _mm256_insertf128_ps(_mm256_castps128_ps256((__m128)x[index[q]]), (__m128)x[index[4 + q]], 1);
        __m256 t0 = _mm256_unpacklo_ps(z[0], z[1]), t1 = _mm256_unpackhi_ps(z[0], z[1]);
        __m256 t2 = _mm256_unpacklo_ps(z[2], z[3]), t3 = _mm256_unpackhi_ps(z[2], z[3]);
        out[0] = (V)_mm256_shuffle_ps(t0, t2, 0x44);
        out[1] = (V)_mm256_shuffle_ps(t0, t2, 0xee);
        out[2] = (V)_mm256_shuffle_ps(t1, t3, 0x44);
#ifdef __AVX512F__
    } else {
        __m512 z[4];
        for (int q = 0; q < 4; q++) {
            z[q] = _mm512_castps128_ps512((__m128)x[index[q]]);
            z[q] = _mm512_insertf32x4(z[q], (__m128)x[index[4 + q]], 1);
            z[q] = _mm512_insertf32x4(z[q], (__m128)x[index[8 + q]], 2);
            z[q] = _mm512_insertf32x4(z[q], (__m128)x[index[12 + q]], 3);
        }
        __m512 t0 = _mm512_unpacklo_ps(z[0], z[1]), t1 = _mm512_unpackhi_ps(z[0], z[1]);
        __m512 t2 = _mm512_unpacklo_ps(z[2], z[3]), t3 = _mm512_unpackhi_ps(z[2], z[3]);
        out[0] = (V)_mm512_shuffle_ps(t0, t2, 0x44);
        out[1] = (V)_mm512_shuffle_ps(t0, t2, 0xee);
        out[2] = (V)_mm512_shuffle_ps(t1, t3, 0x44);
#endif
    }
}

// The N vectors (x, y, z, 0) of the components of N points
template <int N, typename V = typename Lanes<N>::Float>
inline void to_points(const V in[3], Four* out) {
    if constexpr (N == 1) {
        *out = Four{in[0], in[1], in[2], 0.0f};
    } else if constexpr (N == 8) {
        __m256 x = (__m256)in[0], y = (__m256)in[1], z = (__m256)in[2], w = _mm256_setzero_ps();
        __m256 t0 = _mm256_unpacklo_ps(x, y), t1 = _mm256_unpackhi_ps(x, y);
        __m256 t2 = _mm256_unpacklo_ps(z, w), t3 = _mm256_unpackhi_ps(z, w);
        __m256 p[4] = {_mm256_shuffle_ps(t0, t2, 0x44), _mm256_shuffle_ps(t0, t2, 0xee),
                       _mm256_shuffle_ps(t1, t3, 0x44), _mm256_shuffle_ps(t1, t3, 0xee)};
        for (int q = 0; q < 4; q++) {
            out[q] = (Four)_mm256_castps256_ps128(p[q]);
            out[4 + q] = (Four)_mm256_extractf128_ps(p[q], 1);
        }
#ifdef __AVX512F__
    } else {
        __m512 x = (__m512)in[0], y = (__m512)in[1], z = (__m512)in[2], w = _mm512_setzero_ps();
        __m512 t0 = _mm512_unpacklo_ps(x, y), t1 = _mm512_unpackhi_ps(x, y);
        __m512 t2 = _mm512_unpacklo_ps(z, w), t3 = _mm512_unpackhi_ps(z, w);
        __m512 p[4] = {_mm512_shuffle_ps(t0, t2, 0x44), _mm512_shuffle_ps(t0, t2, 0xee),
                       _mm512_shuffle_ps(t1, t3, 0x44), _mm512_shuffle_ps(t1, t3, 0xee)};
        for (int q = 0; q < 4; q++) {
            out[q] = (Four)_mm512_castps512_ps128(p[q]);
            out[4 + q] = (Four)_mm512_extractf32x4_ps(p[q], 1);
            out[8 + q] = (Four)_mm512_extractf32x4_ps(p[q], 2);
            out[12 + q] = (Four)_mm512_extractf32x4_ps(p[q], 3);
        }
#endif
    }
}

// --- blocks of N strips of K cells -----------------------------------------------------------------------------

constexpr int CORNERS = 4;

// Cell k of a strip has the strip's points k to k + 3.
template <int K, int N>
struct alignas(4 * N) Block {
    using V = typename Lanes<N>::Float;
    int32_t point[K + 3][N];
    V B[K][3][3];
    V a[K], b[K];  // volume times parameters
};

template <typename Material, int K, int N>
inline void block_forces(const Block<K, N>& block, const Four* u, typename Lanes<N>::Float f[K + 3][3]) {
    using V = typename Lanes<N>::Float;
    V p[K + 3][3];
    for (int i = 0; i < K + 3; i++) load_points<N>(u, block.point[i], p[i]);
    for (int i = 0; i < K + 3; i++)
        for (int c = 0; c < 3; c++) f[i][c] = V{};
#pragma GCC unroll 4
    for (int k = 0; k < K; k++) {
        Matrix<V> H;
        for (int i = 0; i < 3; i++) {
            V e0 = p[k + 1][i] - p[k][i], e1 = p[k + 2][i] - p[k][i], e2 = p[k + 3][i] - p[k][i];
            for (int j = 0; j < 3; j++)
                H.a[i][j] = e0 * block.B[k][0][j] + e1 * block.B[k][1][j] + e2 * block.B[k][2][j];
        }
        Matrix<V> P = Material::stress(H, block.a[k], block.b[k]);
        for (int i = 0; i < 3; i++) {
            V total = V{};
            for (int j = 0; j < 3; j++) {
                V g = P.a[i][0] * block.B[k][j][0] + P.a[i][1] * block.B[k][j][1] + P.a[i][2] * block.B[k][j][2];
                f[k + 1 + j][i] -= g;
                total += g;
            }
            f[k][i] += total;
        }
    }
}

// --- the mesh ------------------------------------------------------------------------------------------------------

struct Mesh {
    int64_t cell_count, point_count;
    std::vector<std::array<int32_t, CORNERS>> cells;
    std::vector<std::array<float, 9>> B;
    std::vector<std::array<float, 2>> weights;
    std::vector<float> inverse_mass;
    std::vector<std::array<float, 3>> u;
    float dt;

    explicit Mesh(const char* path) {
        std::ifstream file(path, std::ios::binary);
        auto read = [&](auto* data, size_t count) { file.read((char*)data, count * sizeof(*data)); };
        read(&cell_count, 1), read(&point_count, 1);
        cells.resize(cell_count), B.resize(cell_count), weights.resize(cell_count);
        inverse_mass.resize(point_count), u.resize(point_count);
        read(cells.data(), cell_count), read(B.data(), cell_count), read(weights.data(), cell_count);
        read(inverse_mass.data(), point_count), read(u.data(), point_count), read(&dt, 1);
        if (!file) std::fprintf(stderr, "cannot read %s\n", path), std::exit(1);
    }
};

// Cells in strips of up to K: each shares a face with the one before, opposite the strip's first point of the two.
struct Strip {
    int count = 0;
    std::array<int32_t, 8> cell;
    std::array<int32_t, 11> point;
};

std::vector<Strip> make_strips(const Mesh& mesh, int K) {
    using Face = std::array<int32_t, 3>;
    std::vector<std::array<int32_t, CORNERS>> neighbour(mesh.cell_count);
    if (K > 1) {
        std::vector<std::pair<Face, int64_t>> faces;
        faces.reserve(4 * mesh.cell_count);
        for (int64_t c = 0; c < mesh.cell_count; c++)
            for (int k = 0; k < CORNERS; k++) {
                Face face;
                for (int i = 0, n = 0; i < CORNERS; i++)
                    if (i != k) face[n++] = mesh.cells[c][i];
                std::sort(face.begin(), face.end());
                faces.push_back({face, 4 * c + k});
                neighbour[c][k] = -1;
            }
        std::sort(faces.begin(), faces.end());
        for (size_t i = 1; i < faces.size(); i++)
            if (faces[i].first == faces[i - 1].first) {
                int64_t p = faces[i].second, q = faces[i - 1].second;
                neighbour[p / 4][p % 4] = q / 4, neighbour[q / 4][q % 4] = p / 4;
            }
    }
    std::vector<char> taken(mesh.cell_count);
    auto opposite = [&](int32_t c, int32_t point) {  // the free neighbour across the face opposite to a point
        for (int k = 0; k < CORNERS; k++)
            if (mesh.cells[c][k] == point) {
                int32_t n = neighbour[c][k];
                return n >= 0 && !taken[n] ? n : -1;
            }
        return -1;
    };
    auto freedom = [&](int32_t c) {
        int count = 0;
        for (int n : neighbour[c]) count += n >= 0 && !taken[n];
        return count;
    };
    auto apex = [&](int32_t c, const int32_t* face) {
        for (int32_t p : mesh.cells[c])
            if (p != face[0] && p != face[1] && p != face[2]) return p;
        return -1;
    };
    std::vector<Strip> strips;
    for (int64_t start = 0; start < mesh.cell_count; start++) {
        if (taken[start]) continue;
        Strip best;
        std::array<int32_t, CORNERS> order = mesh.cells[start];
        std::sort(order.begin(), order.end());
        int least = 1 << 30;
        do {  // all ways to order the first cell's points; the strip follows from them
            Strip strip;
            std::copy(order.begin(), order.end(), strip.point.begin());
            strip.cell[strip.count++] = start;
            taken[start] = 1;
            while (strip.count < K) {
                const int32_t* last = &strip.point[strip.count - 1];
                int32_t next = opposite(strip.cell[strip.count - 1], last[0]);
                if (next < 0) break;
                strip.point[strip.count + 3] = apex(next, last + 1);
                strip.cell[strip.count++] = next;
                taken[next] = 1;
            }
            int left = 0;  // prefer the cells with the fewest free neighbours, which are hardest to place later
            for (int k = 0; k < strip.count; k++) left += freedom(strip.cell[k]);
            for (int k = 0; k < strip.count; k++) taken[strip.cell[k]] = 0;
            if (strip.count > best.count || (strip.count == best.count && left < least)) best = strip, least = left;
        } while (K > 1 && std::next_permutation(order.begin(), order.end()));
        for (int k = 0; k < best.count; k++) taken[best.cell[k]] = 1;
        strips.push_back(best);
    }
    return strips;
}

// D^-1 of a cell for its points in another order: the gradients of the shape functions go with the points
void shape_gradients(const Mesh& mesh, int32_t c, const int32_t* points, float out[3][3]) {
    const auto& B = mesh.B[c];
    for (int k = 0; k < 3; k++)
        for (int i = 0; i < CORNERS; i++)
            if (mesh.cells[c][i] == points[k + 1])
                for (int j = 0; j < 3; j++)
                    out[k][j] = i ? B[3 * (i - 1) + j] : -(B[j] + B[3 + j] + B[6 + j]);
}

// Threads have stretches of the list of strips of their own; neighbours in it are in neighbouring lanes.
template <int K, int N>
std::vector<std::vector<Block<K, N>>> make_blocks(const Mesh& mesh, int threads) {
    std::vector<Strip> strips = make_strips(mesh, K);
    std::vector<std::vector<Block<K, N>>> result(threads);
    for (int t = 0; t < threads; t++) {
        int64_t begin = strips.size() * t / threads, end = strips.size() * (t + 1) / threads;
        int64_t count = (end - begin + N - 1) / N;
        result[t].resize(count);
        for (int64_t b = 0; b < count; b++)
            for (int lane = 0; lane < N; lane++) {
                int64_t s = begin + b * N + lane;
                bool present = s < end;
                const Strip& strip = strips[present ? s : end - 1];
                Block<K, N>& block = result[t][b];
                auto put = [lane](typename Lanes<N>::Float& v, float x) { ((float*)&v)[lane] = x; };
                for (int i = 0; i < K + 3; i++)
                    block.point[i][lane] = strip.point[std::min(i, strip.count + 2)];
                for (int k = 0; k < K; k++) {
                    bool real = present && k < strip.count;
                    float B[3][3] = {};
                    if (real) shape_gradients(mesh, strip.cell[k], &strip.point[k], B);
                    for (int i = 0; i < 9; i++) put(block.B[k][i / 3][i % 3], B[i / 3][i % 3]);
                    put(block.a[k], real ? mesh.weights[strip.cell[k]][0] : 0.0f);
                    put(block.b[k], real ? mesh.weights[strip.cell[k]][1] : 0.0f);
                }
            }
    }
    return result;
}

// --- steps ---------------------------------------------------------------------------------------------------------

using Points = std::vector<Four>;

class Barrier {  // threads that wait spin: a step is shorter than a sleep
    std::atomic<int> waiting{0}, phase{0};
    int threads;

  public:
    explicit Barrier(int threads) : threads(threads) {}
    void wait() {
        int now = phase.load(std::memory_order_relaxed);
        if (waiting.fetch_add(1, std::memory_order_acq_rel) == threads - 1) {
            waiting.store(0, std::memory_order_relaxed);
            phase.store(now + 1, std::memory_order_release);
        } else
            while (phase.load(std::memory_order_acquire) == now) _mm_pause();
    }
};

struct Run {
    const Mesh& mesh;
    int threads, steps, repeats;
    const char *forces_path, *displacements_path;

    // forces(thread) writes to what collect(i) sums for a point, and clears
    template <typename Forces, typename Collect>
    void operator()(Points& u, Forces forces, Collect collect) const {
        int64_t n = mesh.point_count;
        auto write = [n](const char* path, auto point) {
            std::ofstream file(path, std::ios::binary);
            for (int64_t i = 0; i < n; i++) {
                Four x = point(i);
                file.write((char*)&x, 12);
            }
        };
#pragma omp parallel num_threads(threads)
        forces(omp_get_thread_num());
        write(forces_path, collect);
        Points v(n, Four{});
        Points start = u;
        Barrier barrier(threads);
        for (int repeat = 0; repeat < repeats; repeat++) {
            u = start;
            std::fill(v.begin(), v.end(), Four{});
            auto begin = std::chrono::steady_clock::now();
#pragma omp parallel num_threads(threads)
            {
                int t = omp_get_thread_num();
                int64_t from = n * t / threads, to = n * (t + 1) / threads;
                for (int step = 0; step < steps; step++) {
                    forces(t);
                    barrier.wait();
                    for (int64_t i = from; i < to; i++) {
                        v[i] += mesh.dt * mesh.inverse_mass[i] * collect(i);
                        u[i] += mesh.dt * v[i];
                    }
                    barrier.wait();
                }
            }
            std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - begin;
            std::printf("%.9g\n", elapsed.count());
        }
        write(displacements_path, [&u](int64_t i) { return u[i]; });
    }
};

template <typename Material, int K, int N>
void strips(const Mesh& mesh, const Run& run) {
    auto blocks = make_blocks<K, N>(mesh, run.threads);
    Points u(mesh.point_count);
    for (int64_t i = 0; i < mesh.point_count; i++) u[i] = Four{mesh.u[i][0], mesh.u[i][1], mesh.u[i][2], 0.0f};
    std::vector<Points> force(run.threads, Points(mesh.point_count, Four{}));
    auto forces = [&](int t) {
        Four* f = force[t].data();
        for (const auto& block : blocks[t]) {
            for (size_t o = 0; o < sizeof(block); o += 64)  // hardware prefetchers stop at the end of a page
                _mm_prefetch((const char*)(&block + 2) + o, _MM_HINT_T0);
            typename Lanes<N>::Float part[K + 3][3];
            block_forces<Material>(block, u.data(), part);
            for (int i = 0; i < K + 3; i++) {
                Four corner[N];
                to_points<N>(part[i], corner);
                for (int lane = 0; lane < N; lane++) f[block.point[i][lane]] += corner[lane];
            }
        }
    };
    auto collect = [&](int64_t i) {
        Four sum = force[0][i];
        force[0][i] = Four{};
        for (int t = 1; t < run.threads; t++) {
            sum += force[t][i];
            force[t][i] = Four{};
        }
        return sum;
    };
    run(u, forces, collect);
}

template <typename Material, int K, int N>
void sums(const Mesh& mesh, const Run& run) {
    auto blocks = make_blocks<K, N>(mesh, run.threads);
    Points u(mesh.point_count);
    for (int64_t i = 0; i < mesh.point_count; i++) u[i] = Four{mesh.u[i][0], mesh.u[i][1], mesh.u[i][2], 0.0f};
    std::vector<int64_t> offset(run.threads + 1);
    for (int t = 0; t < run.threads; t++) offset[t + 1] = offset[t] + blocks[t].size() * (K + 3) * N;
    std::vector<std::vector<int32_t>> slots(mesh.point_count);
    for (int t = 0; t < run.threads; t++)
        for (size_t b = 0; b < blocks[t].size(); b++)
            for (int i = 0; i < K + 3; i++)
                for (int lane = 0; lane < N; lane++)
                    slots[blocks[t][b].point[i][lane]].push_back(offset[t] + (b * (K + 3) + i) * N + lane);
    std::vector<int32_t> starts{0}, list;
    for (auto& s : slots) {
        list.insert(list.end(), s.begin(), s.end());
        starts.push_back(list.size());
    }
    Points corner(offset.back());
    auto forces = [&](int t) {
        Four* out = corner.data() + offset[t];
        for (const auto& block : blocks[t]) {
            typename Lanes<N>::Float part[K + 3][3];
            block_forces<Material>(block, u.data(), part);
            for (int i = 0; i < K + 3; i++, out += N) to_points<N>(part[i], out);
        }
    };
    auto collect = [&](int64_t i) {
        Four sum{};
        for (int32_t k = starts[i]; k < starts[i + 1]; k++) sum += corner[list[k]];
        return sum;
    };
    run(u, forces, collect);
}

template <typename Material>
bool choose(const std::string& variant, const Mesh& mesh, const Run& run) {
    std::map<std::string, void (*)(const Mesh&, const Run&)> variants = {
        {"scalar", strips<Material, 1, 1>},
        {"lanes8", strips<Material, 1, 8>},
        {"strips3x8", strips<Material, 3, 8>},
        {"sums8", sums<Material, 1, 8>},
        {"sums3x8", sums<Material, 3, 8>},
#ifdef __AVX512F__
        {"lanes16", strips<Material, 1, 16>},
        {"strips3x16", strips<Material, 3, 16>},
        {"sums16", sums<Material, 1, 16>},
#endif
    };
    auto found = variants.find(variant);
    if (found == variants.end()) return false;
    found->second(mesh, run);
    return true;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 9) return std::fprintf(stderr, "8 arguments are needed, see the top of the file\n"), 1;
    Mesh mesh(argv[1]);
    std::string material = argv[2], variant = argv[3];
    Run run{mesh, std::atoi(argv[4]), std::atoi(argv[5]), std::atoi(argv[6]), argv[7], argv[8]};
    bool known = material == "stable_neo_hookean" ? choose<StableNeoHookean>(variant, mesh, run)
                 : material == "neo_hookean"      ? choose<NeoHookean>(variant, mesh, run)
                 : material == "fixed_corotated"  ? choose<FixedCorotated>(variant, mesh, run)
                                                  : false;
    if (!known) return std::fprintf(stderr, "unknown material or variant\n"), 1;
}
