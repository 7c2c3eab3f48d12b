/* The C half of faces.cc: the state is one, however many files include the header. */
#include "failover.h"

int64_t commit_in_c(void);
int64_t commit_in_c(void) { return failover_commit(); }
