// Attributes of functions.
#ifndef QUADRL_EXPORT_H_
#define QUADRL_EXPORT_H_

// Exported by the library.
#define QUADRL_EXPORT __attribute__((visibility("default")))

// Compiled for several kinds of vector instructions, of which the best is chosen when the library
// is loaded. Sanitizers are not ready at that time.
#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && \
    !defined(__SANITIZE_ADDRESS__)
#define VECTORISED __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define VECTORISED
#endif

#endif
