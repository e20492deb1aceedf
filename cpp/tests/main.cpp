// Runs every test, or those whose name holds the first argument. For comparing machines instead:
// `--images FILE` draws a few scenes into a file, `--compare FILE FILE` tells how far two differ.
#include <chrono>
#include <cstring>

#include "check.h"
#include "images.h"

int main(int argument_count, char** arguments) {
  using namespace aomgen::tests;
  std::setvbuf(stdout, nullptr, _IOLBF, 0);
  if (argument_count == 3 && std::strcmp(arguments[1], "--images") == 0) return write_images(arguments[2]) ? 0 : 1;
  if (argument_count == 4 && std::strcmp(arguments[1], "--compare") == 0) return same_images(arguments[2], arguments[3]) ? 0 : 1;
  const char* filter = argument_count > 1 ? arguments[1] : "";
  int ran = 0;
  for (const Test& test : all_tests()) {
    if (!std::strstr(test.name, filter)) continue;
    const int before = progress().failures;
    progress().subject.clear();
    const auto start = std::chrono::steady_clock::now();
    test.run();
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    std::printf("%-6s %6.2f s  %s\n", progress().failures == before ? "ok" : "FAILED", seconds, test.name);
    ++ran;
  }
  std::printf("%d tests, %d failed checks\n", ran, progress().failures);
  return ran > 0 && progress().failures == 0 ? 0 : 1;
}
