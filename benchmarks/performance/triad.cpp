// The bandwidth of a = b + s c (McCalpin's STREAM triad), in bytes per second, best of 20.
//
//     triad MEGABYTES THREADS

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <memory>

int main(int argc, char** argv) {
    if (argc != 3) return 1;
    const long count = std::atof(argv[1]) * 1e6 / 3 / sizeof(float);
    const int threads = std::atoi(argv[2]), passes = std::max(1L, 50'000'000 / count);
    std::unique_ptr<float[]> a(new float[count]), b(new float[count]), c(new float[count]);
#pragma omp parallel for num_threads(threads)
    for (long i = 0; i < count; i++) a[i] = 0.0f, b[i] = 1.0f, c[i] = 2.0f;
    double best = 1e9;
    for (int repeat = 0; repeat < 20; repeat++) {
        auto start = std::chrono::steady_clock::now();
        for (int pass = 0; pass < passes; pass++) {
            const float s = 0.5f + pass;
#pragma omp parallel for simd num_threads(threads)
            for (long i = 0; i < count; i++) a[i] = b[i] + s * c[i];
        }
        std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
        best = std::min(best, elapsed.count());
    }
    if (a[count / 2] == 0.0f) return 1;
    std::printf("%.9g\n", 3.0 * sizeof(float) * count * passes / best);
}
