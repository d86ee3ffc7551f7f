// WIDE functions exist twice: for any CPU, and for those that do four numbers at once; which one is
// called is decided when the library is loaded. Both compute the same bits: nothing is fused.

#pragma once

#if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif
