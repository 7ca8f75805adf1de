// Prints the poses of a running service: client [PORT].   c++ -std=c++17 client.cpp -o client
#include <arpa/inet.h>
#include <cstdio>
#include <cstdlib>
#include <cstring>

int main(int argc, char **argv) {
  sockaddr_in to{AF_INET, htons(argc > 1 ? std::atoi(argv[1]) : 7000), {htonl(INADDR_LOOPBACK)}, {}};
  int fd = socket(AF_INET, SOCK_STREAM, 0);
  if (connect(fd, reinterpret_cast<sockaddr *>(&to), sizeof to) != 0) return std::perror("connect"), 1;
  char line[8192];
  for (FILE *in = fdopen(fd, "r"); std::fgets(line, sizeof line, in);) {
    double x, y, z;
    const char *at = std::strstr(line, "\"map_position\":[");
    if (at && std::sscanf(at, "\"map_position\":[%lf,%lf,%lf", &x, &y, &z) == 3)
      std::printf("%.3f %.3f %.3f\n", x, y, z), std::fflush(stdout);
  }
}
