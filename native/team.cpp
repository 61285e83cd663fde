#include "team.hpp"

#include <sched.h>
#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <exception>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <thread>
#include <vector>

namespace spikerig {
namespace {

int usable_cpus() {
#if defined(__linux__)
  cpu_set_t set;
  CPU_ZERO(&set);
  if (sched_getaffinity(0, sizeof set, &set) == 0) return CPU_COUNT(&set);
#endif
  int n = static_cast<int>(std::thread::hardware_concurrency());
  return n > 0 ? n : 1;
}

// One job at a time: the caller works too, helpers pick up parts until none is left. Helpers sleep between
// jobs rather than spin, since torch has a pool of its own on the same cores.
class Team {
 public:
  explicit Team(int size) : pid_(getpid()) {
    for (int i = 1; i < size; ++i) crew_.emplace_back([this] { serve(); });
  }

  ~Team() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
    }
    wake_.notify_all();
    for (auto &t : crew_) t.join();
  }

  int size() const { return static_cast<int>(crew_.size()) + 1; }
  pid_t pid() const { return pid_; }

  void run(int parts, const std::function<void(int)> &work) {
    std::lock_guard<std::mutex> one_job(job_mutex_);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      work_ = &work;
      parts_ = parts;
      next_.store(0);
      busy_ = static_cast<int>(crew_.size());
      error_ = nullptr;
      ++job_;
    }
    wake_.notify_all();
    take_parts();
    std::unique_lock<std::mutex> lock(mutex_);
    done_.wait(lock, [this] { return busy_ == 0; });
    work_ = nullptr;
    if (error_) std::rethrow_exception(error_);
  }

 private:
  void take_parts() {
    try {
      for (int part = next_++; part < parts_; part = next_++) (*work_)(part);
    } catch (...) {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!error_) error_ = std::current_exception();
      next_.store(parts_);
    }
  }

  void serve() {
    long seen = 0;
    for (;;) {
      std::unique_lock<std::mutex> lock(mutex_);
      wake_.wait(lock, [&] { return stop_ || job_ != seen; });
      if (stop_) return;
      seen = job_;
      lock.unlock();
      take_parts();
      lock.lock();
      if (--busy_ == 0) done_.notify_one();
    }
  }

  pid_t pid_;
  std::vector<std::thread> crew_;
  std::mutex job_mutex_, mutex_;
  std::condition_variable wake_, done_;
  const std::function<void(int)> *work_ = nullptr;
  std::atomic<int> next_{0};
  int parts_ = 0, busy_ = 0;
  long job_ = 0;
  bool stop_ = false;
  std::exception_ptr error_;
};

std::mutex team_mutex;
Team *team = nullptr;  // never destroyed at exit: joining threads in static destructors can hang an interpreter
int wanted = 0;
thread_local bool inside = false;

}  // namespace

int threads() {
  std::lock_guard<std::mutex> lock(team_mutex);
  if (wanted == 0) {
    const char *text = std::getenv("SPIKERIG_THREADS");
    int n = text ? std::atoi(text) : 0;
    wanted = n >= 1 && n <= 256 ? n : usable_cpus();
  }
  return wanted;
}

void set_threads(int n) {
  if (n < 1 || n > 256) throw std::invalid_argument("threads must be 1..256");
  std::lock_guard<std::mutex> lock(team_mutex);
  wanted = n;
}

void parallel(int parts, const std::function<void(int)> &work) {
  int size = threads();
  if (parts <= 1 || size == 1 || inside) {  // a nested call runs in the caller's own thread
    for (int part = 0; part < parts; ++part) work(part);
    return;
  }
  Team *mine;
  {
    std::lock_guard<std::mutex> lock(team_mutex);
    if (team && team->pid() != getpid()) team = nullptr;  // after fork the crew is gone: leak it, start anew
    if (!team || team->size() != size) {
      delete team;
      team = new Team(size);
    }
    mine = team;
  }
  mine->run(parts, [&](int part) {
    inside = true;
    struct Leave { ~Leave() { inside = false; } } leave;
    work(part);
  });
}

}  // namespace spikerig
