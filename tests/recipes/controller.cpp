// Two threads: one works a hundred times a second, the other prints the number of each turn.
#include <chrono>
#include <cstdio>
#include <cstring>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

int main() {
    std::mutex guard;
    std::condition_variable turned;
    std::vector<long> values(1000);
    long turns = 0;
    std::thread worker([&] {
        for (;;) {
            std::this_thread::sleep_for(std::chrono::milliseconds(10));
            std::lock_guard<std::mutex> held(guard);
            values[turns++ % values.size()] += turns;
            turned.notify_one();
        }
    });
    for (long seen = 0;;) {
        std::unique_lock<std::mutex> held(guard);
        turned.wait(held, [&] { return turns > seen; });
        while (seen < turns) std::printf("%ld\n", seen++);
        std::fflush(stdout);
    }
}
