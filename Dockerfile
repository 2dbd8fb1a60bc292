# ROS 2 of apt with this package, for amd64 and arm64: the steps of docs/install.md.
#   docker build --tag drocap_ros .                                  Jazzy, Ubuntu 24.04
#   docker build --build-arg ROS_DISTRO=lyrical --tag drocap_ros .   Lyrical, Ubuntu 26.04
#   docker run --rm -it --network host --device /dev/ttyACM0 --device /dev/video0 --volume "$PWD:/data" drocap_ros
# ROS discovers its peers by multicast, so a graph with other computers needs the host's network.
ARG ROS_DISTRO=jazzy
FROM ros:${ROS_DISTRO}-ros-base

ARG DEBIAN_FRONTEND=noninteractive
RUN apt-get update && apt-get install --yes --no-install-recommends \
        ros-${ROS_DISTRO}-tf2-msgs ros-${ROS_DISTRO}-visualization-msgs ros-${ROS_DISTRO}-diagnostic-msgs \
        build-essential cmake python3-venv python3-numpy python3-scipy python3-opencv python3-matplotlib python3-rich \
        python3-serial python3-yaml \
    && rm -rf /var/lib/apt/lists/*

# What apt does not have; --system-site-packages keeps apt's NumPy, SciPy and OpenCV.
RUN python3 -m venv --system-site-packages /opt/drocap \
    && /opt/drocap/bin/pip install --no-cache-dir \
        onnxruntime "av>=17.1" pymavlink "mcap>=1.6" "rosbags>=0.10" pyulog threadpoolctl c3d argcomplete "setuptools>=77" wheel

COPY . /opt/drocap_ros
RUN . /opt/ros/${ROS_DISTRO}/setup.sh \
    && /opt/drocap/bin/pip install --no-cache-dir --no-build-isolation --no-deps /opt/drocap_ros \
    && /opt/drocap/bin/drocap --version

ENV PATH=/opt/drocap/bin:$PATH
WORKDIR /data
# The entrypoint of the image sources ROS.
CMD ["bash"]
