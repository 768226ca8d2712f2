/* What METIS refers to and a nested dissection in memory never calls, so that the files which hold it need
 * not be here: graphs on disk, and partitions of more than two parts. Written for this project. */
#include "metislib.h"

/* What src/ordering.rs knows of metis.h. */
_Static_assert(METIS_NOPTIONS == 40 && METIS_OPTION_SEED == 9 && METIS_OPTION_NUMBERING == 18
                 && METIS_OK == 1 && sizeof(idx_t) == 4, "src/ordering.rs has other constants");

static void absent(const char *name)
{
  fprintf(stderr, "%s is not part of this build of METIS\n", name);
  abort();
}

FILE *gk_fopen(char *fname, char *mode, const char *msg)
{
  (void)fname, (void)mode, (void)msg;
  absent("gk_fopen");
  return NULL;
}

void gk_fclose(FILE *file)
{
  (void)file;
  absent("gk_fclose");
}

int gk_fexists(char *fname)
{
  (void)fname;
  absent("gk_fexists");
  return 0;
}

int gk_rmpath(char *path)
{
  (void)path;
  absent("gk_rmpath");
  return 0;
}

void KWayVolUpdate(ctrl_t *ctrl, graph_t *graph, idx_t v, idx_t from, idx_t to, ipq_t *queue,
         idx_t *vstatus, idx_t *r_nupd, idx_t *updptr, idx_t *updind, idx_t bndtype, idx_t *vmarker,
         idx_t *pmarker, idx_t *modind)
{
  (void)ctrl, (void)graph, (void)v, (void)from, (void)to, (void)queue, (void)vstatus, (void)r_nupd;
  (void)updptr, (void)updind, (void)bndtype, (void)vmarker, (void)pmarker, (void)modind;
  absent("KWayVolUpdate");
}
