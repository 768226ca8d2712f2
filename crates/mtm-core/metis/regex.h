/* GKlib includes regex.h and uses nothing of it here; Windows has no such file. */
