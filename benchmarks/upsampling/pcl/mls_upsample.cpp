// Upsamples a PLY cloud with pcl::MovingLeastSquares and times process() alone.
//
//   mls_upsample CLOUD.ply MODE RADIUS RATIO THREADS REPEATS
//
// MODE is random_uniform_density or sample_local_plane, RADIUS the search radius in the cloud's
// units, RATIO the number of points in all per original that is aimed at. Prints the number of
// points made, then the seconds of each repeat. Exits with 1 and one line on bad input.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <string>
#include <vector>

#include <pcl/io/ply_io.h>
#include <pcl/point_types.h>
#include <pcl/search/kdtree.h>
#include <pcl/surface/mls.h>

using Cloud = pcl::PointCloud<pcl::PointXYZ>;
using Mls = pcl::MovingLeastSquares<pcl::PointXYZ, pcl::PointXYZ>;

struct Options {
  std::string path, mode;
  double radius, ratio;
  unsigned threads;
  int repeats;
};

static int fail(const std::string &why) {
  std::cerr << why << std::endl;
  return 1;
}

// The number of points a base makes follows from the mode's own parameters.
static bool set_mode(Mls &mls, const Options &options, double typical_neighbors) {
  if (options.mode == "random_uniform_density") {
    // A base with m neighbours makes density / (2 m) points in the disc of half the search radius.
    mls.setUpsamplingMethod(Mls::RANDOM_UNIFORM_DENSITY);
    mls.setPointDensity(static_cast<int>(std::lround(2.0 * typical_neighbors * options.ratio)));
    return true;
  }
  if (options.mode == "sample_local_plane") {
    // A grid on a disc of half the search radius: area / step^2 points a base.
    const double disc = 0.5 * options.radius;
    mls.setUpsamplingMethod(Mls::SAMPLE_LOCAL_PLANE);
    mls.setUpsamplingRadius(disc);
    mls.setUpsamplingStepSize(disc * std::sqrt(M_PI / options.ratio));
    return true;
  }
  return false;
}

// Neighbours within the radius, the harmonic mean over up to a thousand points, since a base makes
// points in inverse proportion to its neighbours; the point itself counts.
static double count_neighbors(const Cloud::Ptr &cloud, double radius) {
  pcl::search::KdTree<pcl::PointXYZ> tree;
  tree.setInputCloud(cloud);
  const std::size_t stride = std::max<std::size_t>(1, cloud->size() / 1000);
  pcl::Indices indices;
  std::vector<float> squared;
  double reciprocals = 0.0;
  int asked = 0;
  for (std::size_t i = 0; i < cloud->size(); i += stride, ++asked)
    reciprocals += 1.0 / tree.radiusSearch((*cloud)[i], radius, indices, squared);
  return asked / reciprocals;
}

int main(int argc, char **argv) {
  if (argc != 7) return fail("usage: mls_upsample CLOUD.ply MODE RADIUS RATIO THREADS REPEATS");
  const Options options{argv[1], argv[2], std::atof(argv[3]), std::atof(argv[4]),
                        static_cast<unsigned>(std::atoi(argv[5])), std::atoi(argv[6])};
  Cloud::Ptr cloud(new Cloud);
  if (pcl::io::loadPLYFile(options.path, *cloud) < 0 || cloud->empty())
    return fail("no points in " + options.path);
  const double typical_neighbors = count_neighbors(cloud, options.radius);
  std::string seconds;
  std::size_t num_points = 0;
  for (int repeat = 0; repeat < options.repeats; ++repeat) {
    Mls mls;  // a fresh one each time, so that its search tree is built within process()
    mls.setInputCloud(cloud);
    mls.setSearchRadius(options.radius);
    mls.setPolynomialOrder(2);
    mls.setNumberOfThreads(options.threads);
    if (!set_mode(mls, options, typical_neighbors)) return fail("unknown mode " + options.mode);
    Cloud made;
    const auto started = std::chrono::steady_clock::now();
    mls.process(made);
    const std::chrono::duration<double> took = std::chrono::steady_clock::now() - started;
    seconds += " " + std::to_string(took.count());
    num_points = made.size();
  }
  std::cout << num_points << seconds << std::endl;
  return 0;
}
