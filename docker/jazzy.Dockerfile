# SPDX-License-Identifier: Apache-2.0
# Nodes and command line on the official ROS 2 Jazzy image. In the source tree:
#   docker build --file docker/jazzy.Dockerfile --tag flowing-puppet:jazzy .
#   docker run --rm --network host flowing-puppet:jazzy ros2 launch flowing_puppet_ros camera.launch.py
FROM ros:jazzy-ros-base-noble

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
ENV NUMBA_CACHE_DIR=/var/cache/numba
WORKDIR /ros2_ws

# The manifests first: what they name is installed again only when they change.
COPY package.xml src/flowing_puppet_ros/package.xml
COPY msg_defs/package.xml src/flowing_puppet_ros/msg_defs/package.xml
COPY requirements/lock-noble.txt /tmp/lock-noble.txt
# hadolint ignore=DL3008,DL3013,DL3042
RUN ln -s flowing_puppet_ros/msg_defs src/flowing_puppet_msgs \
    && apt-get update \
    && apt-get install --yes --no-install-recommends python3-pip \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src --yes --rosdistro jazzy \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir --break-system-packages --constraint /tmp/lock-noble.txt \
        threadpoolctl mcap rosbags ai-edge-litert

COPY . src/flowing_puppet_ros
# The replay of the repository's own recording compiles the kernels, and is the test of this image.
RUN . /opt/ros/jazzy/setup.sh \
    && colcon build --cmake-args -DBUILD_TESTING=OFF \
    && . install/setup.sh \
    && ros2 run flowing_puppet_ros flowing-puppet networks --install \
    && ros2 run flowing_puppet_ros flowing-puppet replay src/flowing_puppet_ros/bags/golden --out /tmp/golden.mcap \
    && rm -rf /tmp/golden.mcap build log \
    && chmod -R a+rwX /var/cache/numba

COPY --chmod=755 docker/entrypoint.sh /entrypoint.sh
ENTRYPOINT ["/entrypoint.sh"]
CMD ["ros2", "launch", "flowing_puppet_ros", "camera.launch.py"]
