// The C++ face, in a program of which another file, in C, includes the same header.
#include "failover.h"

#include <cstdio>
#include <vector>

extern "C" int64_t commit_in_c(void);

struct Pose {
    double x, y;
};

int main()
{
    failover::kept<Pose> pose("pose", Pose{1.0, 2.0});
    std::vector<float> map(20000);
    failover::region(map.data(), map.size(), "map");
    failover::task task("faces");
    if (!task) {
        std::printf("%s\n", failover_error());
        return 1;
    }
    pose->x += 1.0;
    map.back() += 0.5f;
    task.commit();
    int64_t number = commit_in_c();
    std::printf("%d %lld %.1f %.1f %.1f %d\n", task.resumed() != nullptr, static_cast<long long>(number), (*pose).x, pose->y,
                static_cast<double>(map.back()), task.wait());
}
