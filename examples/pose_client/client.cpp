// Prints the poses of a running service: client [PORT] [TOKEN_FILE].   c++ -std=c++17 client.cpp -o client
#include <arpa/inet.h>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

int main(int argc, char **argv) {
  sockaddr_in to{AF_INET, htons(argc > 1 ? std::atoi(argv[1]) : 7000), {htonl(INADDR_LOOPBACK)}, {}};
  int fd = socket(AF_INET, SOCK_STREAM, 0);
  if (connect(fd, reinterpret_cast<sockaddr *>(&to), sizeof to) != 0) return std::perror("connect"), 1;
  const char *home = std::getenv("HOME");
  const std::string file = argc > 2 ? argv[2] : std::string(home ? home : "") + "/.local/state/stereo-sfm/token";
  char line[8192];
  if (FILE *token = std::fopen(file.c_str(), "r")) {
    const size_t size = std::fread(line, 1, sizeof line, token);
    if (std::fclose(token) != 0 || send(fd, line, size, 0) < 0) return std::perror("send"), 1;
  }
  for (FILE *in = fdopen(fd, "r"); std::fgets(line, sizeof line, in);) {
    double x, y, z;
    const char *at = std::strstr(line, "\"map_position\":[");
    if (at && std::sscanf(at, "\"map_position\":[%lf,%lf,%lf", &x, &y, &z) == 3)
      std::printf("%.3f %.3f %.3f\n", x, y, z), std::fflush(stdout);
  }
}
