/* Sorting macros in the place of GKlib's, which derive from the GNU C Library and are under the LGPL.
 *
 * Included before every file of METIS: the include guards below are those of the files of GKlib that
 * are under the LGPL, so that these are passed over. Written for this project from the way METIS calls
 * the macros. Wherever keys are equal, the order of entries may differ from GKlib's. */
#ifndef CMFSIM_METIS_SORTING_H
#define CMFSIM_METIS_SORTING_H

#define _GK_MKSORT_H_
#define _GK_GETOPT_H_

/* Sorts the N entries of type TYPE at BASE in place so that IS_LESS(a, b), which takes pointers, never
 * holds for a later a and an earlier b: heapsort (Williams 1964), O(N log N) always, without recursion. */
#define GK_MKQSORT(TYPE, BASE, N, IS_LESS)                                  \
  do {                                                                      \
    TYPE *const entries_ = (BASE);                                          \
    size_t rest_ = (N), root_ = rest_ / 2;                                  \
    while (rest_ > 1) {                                                     \
      TYPE sinking_;                                                        \
      size_t hole_, child_;                                                 \
      if (root_ > 0) {                                                      \
        sinking_ = entries_[--root_];                                       \
      } else {                                                              \
        sinking_ = entries_[--rest_];                                       \
        entries_[rest_] = entries_[0];                                      \
      }                                                                     \
      hole_ = root_;                                                        \
      for (child_ = 2 * hole_ + 1; child_ < rest_; child_ = 2 * hole_ + 1) { \
        if (child_ + 1 < rest_ && IS_LESS(&entries_[child_], &entries_[child_ + 1])) \
          child_++;                                                         \
        if (!IS_LESS(&sinking_, &entries_[child_]))                         \
          break;                                                            \
        entries_[hole_] = entries_[child_];                                 \
        hole_ = child_;                                                     \
      }                                                                     \
      entries_[hole_] = sinking_;                                           \
    }                                                                       \
  } while (0)

#endif
