// Prints poses, events and gaps, one line each.
//
//     g++ -std=c++17 -O2 -Wall -Wextra -o print_poses print_poses.cpp
//     ./print_poses /run/tsgt/poses.sock
//     ./print_poses relay://192.168.1.10 relay.key

#include <cinttypes>
#include <cstdio>
#include <string>

#include "tsgt_stream.hpp"

int main(int argc, char** argv) {
  if (argc < 2) {
    std::fprintf(stderr, "usage: %s SOCKET | relay://HOST[:PORT] KEY_FILE\n", argv[0]);
    return 2;
  }
  try {
    tsgt::Stream stream(argv[1], argc > 2 ? argv[2] : "");
    std::string problem;
    while (true) {
      const auto record = stream.next(std::chrono::milliseconds(200));
      if (stream.problem() != problem && !(problem = stream.problem()).empty()) std::fprintf(stderr, "%s\n", problem.c_str());
      if (!record) continue;
      if (const auto* hello = std::get_if<tsgt::Hello>(&*record)) {
        std::printf("hello %s\n", hello->version.c_str());
      } else if (const auto* gap = std::get_if<tsgt::Gap>(&*record)) {
        std::printf("gap %s %s\n", gap->lines ? std::to_string(*gap->lines).c_str() : "?", gap->reason.c_str());
      } else if (const auto* event = std::get_if<tsgt::Event>(&*record)) {
        std::printf("event %" PRId64 " %s: %s\n", event->stamp_ns, event->event.c_str(), event->message.c_str());
      } else if (const auto* pose = std::get_if<tsgt::Pose>(&*record)) {
        if (pose->kind == "smoothed") continue;  // the same epochs again, a second and more later
        std::printf("pose %" PRId64, pose->stamp_ns);
        if (pose->valid && pose->position_m && pose->orientation_xyzw) {
          for (const double number : *pose->position_m) std::printf(" %.17g", number);
          for (const double number : *pose->orientation_xyzw) std::printf(" %.17g", number);
        } else {
          std::printf(" invalid: %s", pose->reason.c_str());
        }
        std::printf("; age %.3f s\n", pose->age_s());
      }
      std::fflush(stdout);
    }
  } catch (const tsgt::Error& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 1;
  }
}
