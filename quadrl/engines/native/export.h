// What functions are marked with.
#ifndef QUADRL_EXPORT_H_
#define QUADRL_EXPORT_H_

// Seen by whoever loads the library.
#define QUADRL_EXPORT __attribute__((visibility("default")))

// Compiled for several kinds of vector instructions: the best is chosen while the library is loaded,
// before a sanitizer is ready for its own calls.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__)
#define VECTORISED __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define VECTORISED
#endif

#endif
