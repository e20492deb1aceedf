// A test runner that needs nothing else: TEST registers a function, CHECK counts and goes on.
#pragma once

#include <cstdio>
#include <string>
#include <vector>

namespace aomgen::tests {

struct Test {
  const char* name;
  void (*run)();
};

inline std::vector<Test>& all_tests() {
  static std::vector<Test> tests;
  return tests;
}

struct Registration {
  Registration(const char* name, void (*run)()) { all_tests().push_back({name, run}); }
};

// Failed checks so far, and what the running test works on, which every failure prints.
struct Progress {
  int failures = 0;
  std::string subject;
};

inline Progress& progress() {
  static Progress state;
  return state;
}

inline void fail(const char* file, int line, const char* condition) {
  if (++progress().failures <= 40) std::printf("%s:%d: not so: %s  [%s]\n", file, line, condition, progress().subject.c_str());
}

}  // namespace aomgen::tests

#define CHECK(condition) \
  do { \
    if (!(condition)) ::aomgen::tests::fail(__FILE__, __LINE__, #condition); \
  } while (false)

#define TEST(name) \
  static void name(); \
  static const ::aomgen::tests::Registration register_##name(#name, name); \
  static void name()
